# Copyright 2026 The t3mpc_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Launch files: their arguments, and the processes that they start, from start to Ctrl-C."""

from contextlib import contextmanager, suppress
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time
from xml.etree import ElementTree

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader
import numpy as np
import pytest
from support.launch_files import arguments_of, nodes_of
from support.waiting import wait_for_end, wait_for_text, wait_until
import yaml

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.cli.bag import main as bag_main
from t3mpc_ros.cli.process_group import installed_file
from t3mpc_ros.control.controller import Controller
from t3mpc_ros.geometry.polyline import distance_to_path, resample
from t3mpc_ros.model_file import find_model, load_model, read_model
from t3mpc_ros.nodes.registry import parameter_class
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(path.name for path in (ROOT / 'launch').glob('*.launch.py'))
FOLLOW = 'follow.launch.py'


def launched(name, **given):
    return nodes_of(ROOT / 'launch' / name, given, share=ROOT)


def only(nodes, executable):
    (found,) = (node for node in nodes if node.executable == executable)
    return found


# -- arguments ------------------------------------------------------------------------------------


@pytest.mark.parametrize('file', FILES)
def test_every_launch_file_takes_the_common_arguments(file):
    arguments = arguments_of(ROOT / 'launch' / file, share=ROOT)
    assert {'namespace', 'params_file', 'log_level', 'seed'} <= set(arguments)
    assert ('world' in arguments) == ('robot' not in file.split('.') and file != FOLLOW)
    for node in launched(file, namespace='/east/', log_level='warn'):
        assert node.namespace.startswith('east')
        assert node.ros_arguments == ['--log-level', 'warn']


@pytest.mark.parametrize('file', FILES)
def test_launch_file_parameters_fit_their_nodes(file):
    for node in launched(file):
        values = {key: value for key, value in node.all_values.items() if key != 'use_sim_time'}
        parameter_class(node.executable).from_dict(values)
        assert node.name == node.executable


@pytest.mark.parametrize('file', FILES)
def test_the_params_file_overrides_all_but_given_arguments(file, tmp_path):
    path = tmp_path / 'mine.yaml'
    path.write_text(
        '/**/reference_generator: {ros__parameters: {seed: 11, rate: 40.0}}\n'
        '/**/sim_robot: {ros__parameters: {seed: 11, world: corridor}}\n'
        '/**/controller: {ros__parameters: {rate: 40.0, speed_filter: {dead_time: 0.07}}}\n'
    )
    for given, seed in (({}, 11), ({'seed': '5'}, 5)):
        nodes = launched(file, params_file=str(path), **given)
        for node in nodes:
            if node.executable == 'controller':
                assert node.all_values['rate'] == 40.0
                assert node.all_values['speed_filter.dead_time'] == 0.07
            if node.executable in ('sim_robot', 'reference_generator'):
                second = given and node.namespace == 'robot_2'
                assert node.all_values['seed'] == seed + bool(second)
            if node.executable == 'sim_robot':
                assert node.all_values['world'] == 'corridor'
    if 'world' in arguments_of(ROOT / 'launch' / file, share=ROOT):
        for node in launched(file, params_file=str(path), world='room'):
            assert node.executable != 'sim_robot' or node.all_values['world'] == 'room'


@pytest.mark.parametrize(
    'given, error, words',
    [
        ({'params_file': 'missing.yaml'}, FileNotFoundError, 'params_file .* missing.yaml'),
        ({'seed': 'seven'}, ValueError, 'seed must be of type int: got seven'),
    ],
)
@pytest.mark.parametrize('file', FILES)
def test_an_unusable_argument_is_an_error(file, given, error, words):
    """Launch itself passes over a missing parameter file with a warning."""
    with pytest.raises(error, match=words):
        launched(file, **given)


@pytest.mark.parametrize('file', FILES)
def test_the_controller_knows_whether_the_gyro_is_calibrated(file):
    """Two files of the simulated robot left the controller with the tolerance of a data sheet."""
    nodes = launched(file)
    robots = [node for node in nodes if node.executable == 'sim_robot']
    for controller in (node for node in nodes if node.executable == 'controller'):
        stated = controller.all_values.get('body.gyro_scale_tolerance')
        calibrated = parameter_class('sim_robot')().odometry.gyro_scale_tolerance
        assert stated == (calibrated if robots else None)


@pytest.mark.parametrize(('localizer', 'frame'), [('true', 'map'), ('false', 'odom')])
def test_the_path_of_a_patrol_is_in_the_frame_of_its_odometry(localizer, frame):
    """With a localizer odom is in frame map: goals in that frame were refused."""
    nodes = launched('patrol.launch.py', localizer=localizer)
    default = parameter_class('reference_generator')().frame_id
    assert only(nodes, 'reference_generator').values.get('frame_id', default) == frame


def test_a_patrol_of_another_robot_assumes_no_calibration():
    controller = only(launched('patrol.launch.py', robot='false'), 'controller')
    assert 'body.gyro_scale_tolerance' not in controller.all_values


def test_texts_of_arguments_stay_texts():
    """Launch takes 12345 as a number, which is no valid port and no valid file."""
    bridge = only(launched('robot.launch.py', port='12345', key_file='99'), 'radio_bridge')
    assert (bridge.values['port'], bridge.values['key_file']) == ('12345', '99')


@pytest.mark.parametrize('file', ['sim.launch.py', 'robot.launch.py', 'two_robots.launch.py'])
def test_the_robot_description_follows_the_parameters(file, tmp_path):
    path = tmp_path / 'mine.yaml'
    path.write_text(
        '/**: {ros__parameters: {wheel_radius: 0.05, imu_frame_id: gyro, horizon: 3}}\n'
        '/other/sim_robot: {ros__parameters: {imu_frame_id: wrong}}\n'
    )
    given = {'params_file': str(path), 'robot_description': 'true', 'namespace': 'east'}
    nodes = launched(file, **given)
    assert len(nodes) > len(launched(file, params_file=str(path)))
    robots = [node for node in nodes if node.executable in ('sim_robot', 'radio_bridge')]
    publishers = [node for node in nodes if node.executable == 'robot_state_publisher']
    assert len(robots) == len(publishers)
    for robot, publisher in zip(robots, publishers, strict=True):
        assert robot.values['enable_static_tf'] is False, 'not published twice'
        assert publisher.namespace == robot.namespace
        assert publisher.values['frame_prefix'] == f'{robot.namespace}/'
        tree = ElementTree.fromstring(publisher.values['robot_description'])
        assert {tyre.get('radius') for tyre in tree.iter('cylinder')} == {'0.05'}
        assert tree.find("link[@name='gyro']") is not None


@pytest.mark.parametrize('file', ['turtlebot3.yaml', 'generic.yaml'])
def test_robot_files_agree_within_and_with_their_limits(file):
    nodes = launched(FOLLOW, params_file=file)
    controller = only(nodes, 'controller').all_values
    reference = only(nodes, 'reference_generator').all_values
    for name in ('rate', 'wheel_radius', 'wheel_separation'):
        assert controller[name] == reference[name]
    # Standard deviations of the states, and peaks of a day of 13 rad/s at 2.8 rad/s.
    spread = np.array([10.6, 2.22, 0.937, 22.2]) * reference['amplitude']
    assert spread == pytest.approx(np.full(4, spread[0]), rel=0.02)
    peak = spread[0] / 2.8 * 13.0
    assert peak <= controller['wheel.max_velocity']
    assert peak * controller['wheel_radius'] <= controller['linear.x.max_velocity']
    # The wheels are no tighter limit than the velocities of the body.
    turning = controller['angular.z.max_velocity'] * controller['wheel_separation'] / 2
    fastest = max(turning, controller['linear.x.max_velocity'])
    assert controller['wheel.max_velocity'] >= 0.99 * fastest / controller['wheel_radius']
    periods = controller['watchdog.odometry_timeout'] * controller['rate']
    assert periods >= 4
    drive = controller['speed_filter.dead_time'] + 3 * controller['speed_filter.lag']
    assert controller['watchdog.response_window'] >= drive


def test_the_file_of_the_paper_fits_its_plant_and_model():
    nodes = launched('sim.launch.py', params_file='paper_robot.yaml')
    robot, values = only(nodes, 'sim_robot').all_values, only(nodes, 'controller').all_values
    assert robot['drive.kind'] == 'velocity'
    del values['use_sim_time']
    parameters = parameter_class('controller').from_dict(values)
    plant = PaperRobotParameters()
    assert parameters.speed_filter.lag == plant.drive.lag
    assert parameters.speed_filter.dead_time == plant.drive.dead_time
    Controller(parameters).set_weights(load_model(find_model(parameters.model)))
    used = read_model(find_model(parameters.model))[0]['parameters']
    assert parameters.law.gain == pytest.approx(used['law.gain'], rel=0.01)


def test_follow_remaps_the_topics_of_the_robot():
    nodes = launched(
        FOLLOW, odom_topic='/base/odom', cmd_vel_topic='drive', rate='30', record='True'
    )
    expected = [('odom', '/base/odom'), ('cmd_vel', 'drive')]
    assert only(nodes, 'controller').remappings == only(nodes, 'recorder').remappings == expected
    assert {node.all_values['rate'] for node in nodes if 'rate' in node.all_values} == {30.0}
    some = launched(FOLLOW, generate_reference='false', record='false')
    assert [node.executable for node in some] == ['controller']


# -- processes ------------------------------------------------------------------------------------


class Launch:
    """A running launch process, and what it has printed."""

    def __init__(self, process, log):
        self.process = process
        self._log = log

    def output(self):
        return self._log.read_text(errors='replace')

    def pids(self):
        """Return the processes that it has started, by executable."""
        found = re.findall(r'\[(\w+)-\d+\]: process started with pid \[(\d+)\]', self.output())
        return {name: int(pid) for name, pid in found}

    def ends(self):
        """Return executables that have ended, with their exit codes."""
        clean = re.findall(r'\[(\w+)-\d+\]: process has finished cleanly', self.output())
        died = re.findall(r'\[(\w+)-\d+\]: process has died \[.*exit code (-?\d+)', self.output())
        return dict.fromkeys(clean, 0) | {name: int(code) for name, code in died}

    def wait_for(self, words, seconds=600.0):  # a busy machine compiles the kernels for minutes
        wait_for_text(self.process, self.output, words, seconds)


@pytest.fixture
def start(graph, tmp_path):
    """Return a function that starts a module of the tests as a process in the graph."""
    environment = os.environ | {
        'PYTHONPATH': os.pathsep.join(
            [str(ROOT / 'test'), *filter(None, [os.environ.get('PYTHONPATH')])]
        ),
        'PYTHONUNBUFFERED': '1',
        'AMENT_PREFIX_PATH': os.environ.get('AMENT_PREFIX_PATH') or sys.prefix,
    }

    @contextmanager
    def started(module, *words):
        log = tmp_path / f'{module}.log'
        with log.open('wb') as output:
            process = subprocess.Popen(
                [sys.executable, '-m', f'support.{module}', *words],
                cwd=tmp_path,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        launch = Launch(process, log)
        try:
            yield launch
        finally:
            for pid in (process.pid, *launch.pids().values()):
                if process.poll() is None or Path('/proc', str(pid)).exists():
                    os.kill(pid, signal.SIGKILL)
            process.wait()

    return started


LOOP = ('sim_robot', 'controller', 'reference_generator')


@pytest.fixture
def slow(tmp_path):
    """Return the name of a file of parameters with half the rate, and so half the load."""
    content = {f'/**/{name}': {'ros__parameters': {'rate': 50.0}} for name in LOOP}
    (tmp_path / 'slow.yaml').write_text(yaml.safe_dump(content))
    return str(tmp_path / 'slow.yaml')


def launch_file(name):
    return str(installed_file(Path('share/t3mpc_ros/launch') / name))


def end(launch, to_group=False):
    """Interrupt a launch; return the exit codes after checking that nothing is left."""
    pids = launch.pids()
    (os.killpg if to_group else os.kill)(launch.process.pid, signal.SIGINT)
    assert wait_for_end(launch.process) == 0, launch.output()
    assert not [name for name, pid in pids.items() if Path('/proc', str(pid)).exists()]
    codes = launch.ends()
    assert set(codes) == set(pids)
    assert 'Traceback' not in launch.output()
    return codes


def tracking_error(bag, wheel_radius, wheel_separation, *topics):
    """Return the error of a wheel and the RMS of its reference, rad/s, after a start.

    The error is that of the best second: on a busy machine the robot stops now and then, because
    messages are late. ``topics`` are those of the reference and of the measured velocities.
    """
    with open_bag(bag) as recording:
        names = {'v': 'twist.twist.linear.x', 'w': 'twist.twist.angular.z'}
        reference, measured = (recording.series(topic, names) for topic in topics)
    wheels = np.array([[1.0, 0.5 * wheel_separation], [1.0, -0.5 * wheel_separation]])
    at = measured['stamp']
    at = at[(at > at[0] + 3.0) & (at < reference['stamp'][-1])]
    found, wanted = (
        wheels @ [np.interp(at, data['stamp'], data[name]) for name in 'vw'] / wheel_radius
        for data in (measured, reference)
    )
    whole = np.floor(at - at[0])
    seconds = [
        float(np.sqrt(np.mean((found - wanted)[:, whole == second] ** 2)))
        for second in range(int(whole[-1]))
    ]
    assert len(seconds) >= 3
    return min(seconds), float(np.sqrt(np.mean(wanted**2)))


def wait_for_recorded(folder, launch, topics, enough):
    """Wait until what the recorder has written of topics of Odometry is ``enough``.

    The recorder can be seconds behind another subscriber of a topic on a busy machine, so only
    the bag says what it has.
    """
    from nav_msgs.msg import Odometry
    from rclpy.serialization import deserialize_message

    def is_written():
        (file,) = only_bag(folder).glob('*.mcap')
        messages = {topic: [] for topic in topics}
        with file.open('rb') as stream, suppress(EndOfFile):  # the last record may be incomplete
            records = NonSeekingReader(stream).iter_messages(topics, log_time_order=False)
            for _, channel, message in records:
                messages[channel.topic].append(deserialize_message(message.data, Odometry))
        return all(map(enough, messages.values()))

    launch.wait_for('recording to')
    wait_until(is_written, launch.output, step=lambda: time.sleep(0.5))


def lasts(seconds):
    """Return a condition: messages span that time."""
    from support.ros_graph import stamp

    return lambda messages: messages and stamp(messages[-1]) - stamp(messages[0]) > seconds * 1e9


def only_bag(folder):
    (bag,) = folder.glob('bag_*')
    return bag


@pytest.mark.slow
@pytest.mark.timed
@pytest.mark.ros
@pytest.mark.parametrize(
    'to_group',
    [pytest.param(False, id='launch'), pytest.param(True, id='group', marks=pytest.mark.long)],
)
def test_sim_starts_tracks_and_ends_with_ctrl_c(to_group, start, slow, tmp_path):
    """SIGINT to launch alone, and to the whole group as from a terminal."""
    topics = ('/east/reference', '/east/ground_truth/odom')
    words = [launch_file('sim.launch.py'), 'namespace:=east', 'world:=room', 'seed:=3']
    words.append(f'params_file:={slow}')
    with start('launch_files', *words) as launch:
        launch.wait_for('tracking')
        wait_for_recorded(tmp_path, launch, topics, lasts(7.0))
        codes = end(launch, to_group)
    assert codes == dict.fromkeys((*LOOP, 'recorder'), 0)
    bag = only_bag(tmp_path)
    with open_bag(bag) as recording:
        assert recording.metadata_records['sim_robot']['world'] == 'room'
        assert int(recording.metadata_records['reference_generator']['seed']) == 3
        assert {float(recording.metadata_records[name]['rate']) for name in LOOP} == {50.0}
    error, reference = tracking_error(bag, 0.035, 0.147, *topics)
    assert reference > 1.0
    assert error < 0.25 * reference


@pytest.mark.slow
@pytest.mark.timed
@pytest.mark.ros
@pytest.mark.long
@pytest.mark.parametrize(
    'place', [{'localised': 'true'}, {'localizer': 'true', 'known_world': 'room'}], ids=' '.join
)
def test_patrol_drives_its_path(place, start, slow, tmp_path):
    """All that the launch file starts; the robot looks around, and joins its path on the way."""

    def drives(messages):
        places = [(each.pose.pose.position.x, each.pose.pose.position.y) for each in messages]
        return np.hypot(*np.diff(places or [(0.0, 0.0)], axis=0).T).sum() > 1.0

    file, given = 'patrol.launch.py', {**place, 'params_file': slow}
    words = [launch_file(file), *(f'{name}:={value}' for name, value in given.items())]
    with start('launch_files', *words) as launch:
        launch.wait_for('tracking')
        wait_for_recorded(tmp_path, launch, ['/ground_truth/odom'], drives)
        assert not launch.ends(), launch.output()
        codes = end(launch)
    names = (*LOOP, 'recorder', *(['localizer'] if 'localizer' in place else []))
    assert codes == dict.fromkeys(names, 0)
    with open_bag(only_bag(tmp_path)) as recording:
        for node in launched(file, **given):
            values = recording.metadata_records.get(node.name, {})
            for name in node.values:
                assert name == 'use_sim_time' or node.name == 'recorder' or name in values
        names = {'x': 'pose.pose.position.x', 'y': 'pose.pose.position.y'}
        reference = recording.series('/reference', names)
        truth = recording.series('/ground_truth/odom', names)
    driven = np.cumsum(np.hypot(np.diff(truth['x']), np.diff(truth['y'])))
    path, track = (np.column_stack([each['x'], each['y']]) for each in (reference, truth))
    joined = track[np.searchsorted(driven, 0.4) :]
    assert np.median(distance_to_path(joined, resample(path, 0.005))) < 0.02


@pytest.mark.slow
@pytest.mark.timed
@pytest.mark.ros
@pytest.mark.long
def test_a_robot_of_another_make_follows_the_reference(start, tmp_path, capsys):
    """TurtleBot3 figures: 30 Hz best-effort odometry, stamped commands, own topic names."""
    words = [launch_file(FOLLOW), 'params_file:=turtlebot3.yaml', 'rate:=30']
    words += ['odom_topic:=base/odom', 'cmd_vel_topic:=base/cmd_vel']
    remaps = ['--ros-args', '-r', 'odom:=base/odom', '-r', 'cmd_vel:=base/cmd_vel']
    with start('velocity_robot_node', '30', *remaps) as robot:
        robot.wait_for('velocity_robot ready')
        with start('launch_files', *words) as launch:
            launch.wait_for('tracking')
            wait_for_recorded(tmp_path, launch, ['/reference', '/base/odom'], lasts(9.0))
            codes = end(launch, to_group=True)
        assert codes == dict.fromkeys(('controller', 'reference_generator', 'recorder'), 0)
        assert 'the robot expects geometry_msgs/msg/TwistStamped' in launch.output()
    bag = only_bag(tmp_path)
    error, reference = tracking_error(bag, 0.033, 0.160, '/reference', '/base/odom')
    assert reference > 0.5
    assert error < 0.25 * reference
    assert bag_main(['replay', str(bag)]) == 0
    assert 'Odometry is taken from /base/odom' in capsys.readouterr().out


@pytest.mark.ros
def test_a_node_with_a_wrong_parameter_ends_with_code_2(start, tmp_path):
    wrong = tmp_path / 'wrong.yaml'
    wrong.write_text(yaml.safe_dump({'/**/controller': {'ros__parameters': {'law.gian': 1.0}}}))
    words = [launch_file('sim.launch.py'), f'params_file:={wrong}', 'record:=false']
    with start('launch_files', *words) as launch:
        launch.wait_for('process has died')
        assert launch.ends() == {'controller': 2}
        assert 'did you mean law.gain' in launch.output()
        codes = end(launch)  # the others run on
    assert codes == {'controller': 2, 'sim_robot': 0, 'reference_generator': 0}
