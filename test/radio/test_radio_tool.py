# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc robot`` against the emulator: in virtual time, and once over pseudo terminals."""

import math
import os
import random
import signal
import stat
import subprocess
import sys
import threading
import time

import pytest

from t3mpc_ros.cli import robot
from t3mpc_ros.emulator.emulator import Emulator, EmulatorParameters
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.port_actions import Close, Open, Wait, Write
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.authentication import KeyFileError, key_check, read_key
from t3mpc_ros.radio.protocol.codec import decode_from_board, decode_from_dongle
from t3mpc_ros.radio.protocol.frames import CommandFlag, StatusFlag
from t3mpc_ros.radio.tool import channel_scan, jog, key_provisioning, link_test, robot_info
from t3mpc_ros.radio.tool.procedure import Procedure, ProcedureError

KEY, OTHER = bytes(range(16)), bytes(range(1, 17))
START_NS = 5_000_000_000
TURN = 3200


class Bench:
    """An emulator, and whoever holds one of its two ports, in virtual time."""

    def __init__(self, key=b'', seed=1, **flat):
        self.emulator = Emulator(EmulatorParameters.from_dict(flat), key, seed, START_NS)
        self.now_ns = START_NS
        self.each = None

    @property
    def board(self):
        return self.emulator.board

    def carry(self, task, robot=False, seconds=120.0):
        """Carry a task out at the port of the dongle, or of the robot; return it."""
        end, self.is_open, received = self.now_ns + round(seconds * 1e9), False, b''
        while not task.done:
            wake = self._do(task, task.step(self.now_ns, received), robot)
            received = b''
            while self.now_ns < wake and not received:
                following = self.emulator.next_ns
                self.now_ns = min(wake, max(following or wake, self.now_ns + 1000))
                arrived = self.emulator.run_to(self.now_ns)
                cable = self.emulator.take_console()
                if self.is_open:
                    received = b''.join(data for _, data in (cable if robot else arrived))
                if self.is_open and not robot and not self.emulator.port_open:
                    self.is_open = False
                    task.port_failed('dongle is not there', True, self.now_ns)
                    break
            if self.each is not None:
                self.each(self)
            assert self.now_ns < end, 'it must come to an end'
        self._do(task, task.step(self.now_ns), robot)
        assert not self.is_open
        return task

    def _do(self, task, deeds, robot):
        wake = self.now_ns
        for deed in deeds:
            if isinstance(deed, Wait):
                wake = deed.until_ns
            elif isinstance(deed, Open):
                self.is_open = True
                task.port_opened(self.now_ns)
                return self.now_ns
            elif isinstance(deed, Write) and self.is_open and robot:
                self.emulator.feed_console(deed.data, self.now_ns)
            elif isinstance(deed, Write) and self.is_open:
                self.emulator.feed(deed.data, self.now_ns)
            elif isinstance(deed, Close):
                self.is_open = False
        return wake

    def at_dongle(self, talk):
        """Return what a talk with the dongle comes to."""
        return self._result(self.carry(Procedure(talk, decode_from_dongle)))

    def at_robot(self, talk):
        """Return what a talk with the robot's own USB comes to."""
        return self._result(self.carry(Procedure(talk, decode_from_board), robot=True))

    def _result(self, errand):
        if errand.error:
            raise ProcedureError(errand.error)
        return errand.result

    def radio(self):
        """Return how the radio of the dongle is set."""
        return self.emulator.dongle.radio

    def turn(self, wheel, revolutions, key=b'', speed=2.0, link=None):
        said = []
        task = jog.Jog(
            link or LinkParameters(),
            key,
            random.Random(1).randbytes,
            wheel,
            revolutions,
            speed,
            said.append,
        )
        self.carry(task)
        return task, said


# -- key ------------------------------------------------------------------------------------------


def test_a_new_key_is_closed_to_others_and_never_overwrites(tmp_path):
    path = tmp_path / 'key'
    drawn = iter([bytes(16), KEY])  # zeros mean something else: drawn again
    assert key_provisioning.create_key_file(path, lambda size: next(drawn)) == key_check(KEY)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert read_key(path) == KEY
    with pytest.raises(KeyFileError, match='never overwritten'):
        key_provisioning.create_key_file(path, os.urandom)
    link = tmp_path / 'link'
    link.symlink_to(tmp_path / 'elsewhere')
    with pytest.raises(KeyFileError, match='there already'):
        key_provisioning.create_key_file(link, os.urandom)
    with pytest.raises(KeyFileError, match='No such file'):
        key_provisioning.create_key_file(tmp_path / 'nowhere' / 'key', os.urandom)
    assert read_key(path) == KEY


def test_a_key_goes_over_the_cable_and_is_told_apart_at_both_ends():
    bench = Bench()
    assert 'no key' in key_provisioning.format_key_state(
        bench.at_robot(key_provisioning.read_key_state())
    )
    told = bench.at_robot(key_provisioning.write_key(KEY))
    assert f'{key_check(KEY):08x}' in key_provisioning.format_key_state(told)
    assert key_provisioning.holds_key(told, KEY)
    assert not key_provisioning.holds_key(told, OTHER)
    assert bench.board.key_store.create_verifier().key == KEY
    assert key_provisioning.holds_key(bench.at_robot(key_provisioning.write_key(OTHER)), OTHER)
    assert key_provisioning.holds_key(
        bench.at_robot(key_provisioning.write_key(key_provisioning.ERASE_KEY)),
        key_provisioning.ERASE_KEY,
    )
    assert not bench.board.key_store.create_verifier().key


def test_a_board_that_opening_its_port_has_reset_is_waited_for():
    bench = Bench()
    bench.emulator.restart_robot()
    assert key_provisioning.holds_key(bench.at_robot(key_provisioning.write_key(KEY)), KEY)
    assert bench.now_ns - START_NS > 1e9


def test_a_damaged_key_is_told_and_put_right():
    bench = Bench(KEY)
    bench.board.key_store._cells[3] ^= 1
    bench.emulator.restart_robot()
    assert 'damaged' in key_provisioning.format_key_state(
        bench.at_robot(key_provisioning.read_key_state())
    )
    assert key_provisioning.holds_key(bench.at_robot(key_provisioning.write_key(KEY)), KEY)


def test_the_dongle_never_hears_a_key():
    bench = Bench()
    heard = []
    take = bench.emulator.dongle._process
    bench.emulator.dongle._process = lambda data: (heard.append(data), take(data))
    with pytest.raises(ProcedureError, match='this is the dongle'):
        bench.at_dongle(key_provisioning.write_key(KEY))
    assert heard
    assert not any(KEY in data for data in heard)


def test_a_moving_robot_takes_no_key_and_says_what_to_do():
    bench = Bench()
    bench.each = lambda bench: bench.board.receive(
        bytes([0x14, 9, 0, 0]) + bytes(4)
        if bench.board.session != 9
        else bytes([0x11, 9, bench.now_ns // 1000 & 0x7F, CommandFlag.ENABLE, 20]) + bytes(9)
    )
    bench.emulator.run_to(START_NS + 1_000_000)
    bench.each(bench)
    bench.each(bench)
    with pytest.raises(ProcedureError, match='stop the bridge'):
        bench.at_robot(key_provisioning.write_key(KEY))


def test_a_port_where_nobody_answers_is_given_up_with_advice():
    bench = Bench()
    bench.emulator.inject('silence', math.inf)
    with pytest.raises(ProcedureError, match='right port'):
        bench.at_dongle(link_test.run_link_test(LinkParameters(), 1))
    assert 4e9 < bench.now_ns - START_NS < 7e9


# -- ping -----------------------------------------------------------------------------------------


def test_a_good_link_is_called_good_in_every_row():
    bench = Bench()
    seen = bench.at_dongle(link_test.run_link_test(LinkParameters(), 100))
    rows = link_test.evaluate(seen, LinkParameters())
    assert [row.verdict for row in rows] == [link_test.GOOD] * 6
    assert len(seen.pings) == len(seen.cycles) == 100
    assert seen.retransmissions[0] == 200
    assert max(seen.cycles) < 0.01
    assert not bench.board.session
    assert not bench.board.powered
    assert link_test.is_usable(rows)


def test_losses_show_as_tries_and_at_last_as_a_bad_link():
    bench = Bench()
    bench.emulator.inject('loss', math.inf, 0.4)
    seen = bench.at_dongle(link_test.run_link_test(LinkParameters(), 300))
    assert len(seen.cycles) / 300 == pytest.approx(1 - (1 - 0.6**2) ** 4, abs=0.07)
    assert seen.retransmissions[1] > 40
    rows = {row.name: row for row in link_test.evaluate(seen, LinkParameters())}
    assert rows['robot answers by radio'].verdict == link_test.BAD
    assert rows['tries more per packet'].verdict == link_test.POOR
    text = link_test.format_report(list(rows.values()))
    assert '10 uF' in text
    assert text.count('try: ') == 2


def test_a_robot_that_is_off_says_where_to_look():
    bench = Bench()
    bench.emulator.inject('robot_reset', 1000.0)
    rows = link_test.evaluate(
        bench.at_dongle(link_test.run_link_test(LinkParameters(), 10)), LinkParameters()
    )
    text = link_test.format_report(rows)
    assert 't3mpc robot scan' in text
    assert not link_test.is_usable(rows)


def test_a_slow_cable_and_a_damaged_one_are_seen():
    bench = Bench()
    bench.emulator.inject('delay', math.inf, 0.016)
    seen = bench.at_dongle(link_test.run_link_test(LinkParameters(), 20))
    rows = {row.name: row for row in link_test.evaluate(seen, LinkParameters())}
    assert rows['dongle answers over USB'].verdict == link_test.POOR
    assert rows['round trip to the robot'].verdict != link_test.GOOD
    bench = Bench()
    bench.emulator.inject('flip_bits', math.inf, 0.004)
    seen = bench.at_dongle(link_test.run_link_test(LinkParameters(), 200))
    rows = {row.name: row for row in link_test.evaluate(seen, LinkParameters())}
    assert seen.line_errors > 0
    assert rows['frames damaged on the cable'].verdict == link_test.POOR


def test_the_robots_own_port_and_a_dead_chip_are_named():
    bench = Bench()
    with pytest.raises(ProcedureError, match='USB of the robot'):
        bench.at_robot(link_test.run_link_test(LinkParameters(), 1))
    bench = Bench()
    bench.emulator.inject('radio_dead', math.inf)
    with pytest.raises(ProcedureError, match='radio chip'):
        bench.at_dongle(link_test.run_link_test(LinkParameters(), 1))


# -- find -----------------------------------------------------------------------------------------


@pytest.mark.parametrize('channel, rate', [(0, '1M'), (100, '250k'), (125, '2M')])
def test_the_robot_is_found_wherever_it_is_and_the_radio_left_as_it_was(channel, rate):
    bench = Bench(channel=channel, rate=rate)
    before, seen = bench.radio(), []
    talk = channel_scan.scan_channels(
        LinkParameters(), ('250k', '1M', '2M'), lambda *told: seen.append(told)
    )
    (place,) = bench.at_dongle(talk)
    assert (place.channel, place.rate) == (channel, rate)
    assert place.answered == place.asked == 20
    assert [told[:2] for told in seen] == [(number + 1, 378) for number in range(378)]
    assert [text for _, _, text in seen if text] == [channel_scan.format_channel(place)]
    assert bench.radio() == before
    good, advice = channel_scan.recommend([place], LinkParameters())
    assert not good
    assert f'link.channel to {channel} and' in advice
    assert channel_scan.recommend([place], LinkParameters(channel=channel, rate=rate))[0]


def test_a_search_that_is_interrupted_leaves_the_radio_as_it_was():
    bench = Bench(channel=120)
    before = bench.radio()

    def interrupt(bench):
        if bench.radio().channel == 40:
            errand.interrupt(bench.now_ns)

    bench.each = interrupt
    talk = channel_scan.scan_channels(LinkParameters(), ('2M',), lambda *told: None)
    errand = Procedure(talk, decode_from_dongle)
    bench.carry(errand)
    assert errand.error == 'interrupted'
    assert bench.radio() == before


def test_a_dongle_that_is_pulled_out_in_mid_search_ends_it():
    bench = Bench(channel=120)

    def pull(bench):
        if bench.radio().channel == 40 and bench.emulator.port_open:
            bench.emulator.inject('close_port', 100.0)

    bench.each = pull
    with pytest.raises(ProcedureError, match='not there'):
        bench.at_dongle(channel_scan.scan_channels(LinkParameters(), ('1M',), lambda *told: None))


def test_a_robot_that_is_nowhere_gets_advice():
    bench = Bench()
    bench.emulator.inject('jam', math.inf)
    found = bench.at_dongle(
        channel_scan.scan_channels(LinkParameters(), ('1M',), lambda *told: None)
    )
    good, advice = channel_scan.recommend(found, LinkParameters())
    assert found == []
    assert not good
    assert 'is it on' in advice


# -- parameters -----------------------------------------------------------------------------------


@pytest.mark.parametrize('key', [b'', KEY], ids=['open', 'keyed'])
def test_all_parameters_are_read_and_none_is_changed(key):
    bench = Bench(key)
    bench.emulator.inject('loss', math.inf, 0.2)
    talk = robot_info.read_robot_info(LinkParameters(), key, random.Random(1).randbytes)
    inventory = bench.at_dongle(talk)
    told = [(value.value, value.low, value.high) for value in inventory.values]
    assert told == [(row.default, row.low, row.high) for row in frames.BOARD_PARAMETERS]
    assert not bench.board.powered
    lines = robot_info.format_robot_info(
        inventory, LinkParameters.from_dict({'robot.max_speed': 5.0})
    )
    row = next(line for line in lines.splitlines() if line.startswith('max_speed'))
    assert row.split() == ['max_speed', '10000', 'mrad/s', '0', 'to', '19600', '5000']


def test_a_session_of_somebody_else_goes_on_while_parameters_are_read():
    bench = Bench(KEY)
    bench.at_dongle(robot_info.read_robot_info(LinkParameters(), KEY, random.Random(1).randbytes))
    session = bench.board.session
    talk = robot_info.read_robot_info(LinkParameters(), b'', random.Random(2).randbytes)
    assert len(bench.at_dongle(talk).values) == len(frames.BOARD_PARAMETERS)
    assert bench.board.session == session != 0


@pytest.mark.parametrize(
    'here, there, words',
    [(b'', KEY, 'give the host the key'), (KEY, OTHER, 'keys differ'), (KEY, b'', 'no key')],
)
def test_keys_that_do_not_fit_are_named(here, there, words):
    bench = Bench(there)
    with pytest.raises(ProcedureError, match=words):
        bench.at_dongle(
            robot_info.read_robot_info(LinkParameters(), here, random.Random(1).randbytes)
        )


# -- turn -----------------------------------------------------------------------------------------


@pytest.mark.parametrize('key', [b'', KEY], ids=['open', 'keyed'])
@pytest.mark.parametrize('wheel', [jog.LEFT, jog.RIGHT])
@pytest.mark.parametrize('revolutions', [1.0, -0.3])
def test_one_wheel_turns_as_far_as_it_should_and_the_drives_are_out_after_it(
    key, wheel, revolutions
):
    bench = Bench(key)
    task, said = bench.turn(wheel, revolutions, key)
    assert task.error == ''
    turned = task.result
    assert turned.wanted == revolutions * TURN
    assert abs(turned.counted - turned.wanted) <= 10
    assert turned.other == 0
    counters = dict(zip((jog.LEFT, jog.RIGHT), bench.board.counters, strict=True))
    assert counters.pop(wheel) == turned.counted
    assert list(counters.values()) == [0]
    assert not bench.board.powered
    assert said == []
    text = jog.format_result(turned, wheel, revolutions)
    assert ('forward' in text) == (revolutions > 0)


def test_the_wheel_never_turns_faster_or_changes_faster_than_it_may():
    bench, speeds = Bench(), []
    bench.each = lambda bench: speeds.append((bench.now_ns, bench.board.speeds[0] / 1e6))
    task, _ = bench.turn(jog.LEFT, 1.0, speed=1.5)
    assert task.error == ''
    assert max(speed for _, speed in speeds) == pytest.approx(1.5, abs=0.001)
    for (before_ns, before), (after_ns, after) in zip(speeds, speeds[1:], strict=False):
        assert abs(after - before) <= 8.0 * ((after_ns - before_ns) / 1e9 + 2e-3)


def test_an_interruption_brings_the_wheel_to_rest_and_the_drives_out():
    bench = Bench()
    task = jog.Jog(
        LinkParameters(), b'', random.Random(1).randbytes, jog.LEFT, 5.0, 3.0, lambda text: None
    )

    def interrupt(bench):
        if bench.board.counters[0] > 2000:
            task.interrupt(bench.now_ns)

    bench.each = interrupt
    bench.carry(task)
    assert task.error == 'interrupted'
    assert 2000 < task.result.counted < 3000
    assert task.result.counted == bench.board.counters[0]
    assert bench.board.speeds == (0, 0)
    assert not bench.board.powered


@pytest.mark.parametrize(
    'fault, words', [('button', 'emergency stop'), ('jam', 'does not answer')]
)
def test_what_hinders_the_wheel_ends_it_with_its_reason(fault, words):
    bench = Bench()

    def hinder(bench):
        if bench.board.counters[0] > 1000 and not bench.emulator.faults.active(fault):
            bench.emulator.inject(fault, 1000.0)

    bench.each = hinder
    task, _ = bench.turn(jog.LEFT, 5.0)
    assert words in task.error
    bench.emulator.run_to(bench.now_ns + 1_000_000_000)
    assert bench.board.speeds == (0, 0)


def test_a_robot_that_does_not_answer_is_waited_for_and_said():
    bench = Bench()
    bench.emulator.inject('jam', math.inf)
    task, said = bench.turn(jog.LEFT, 1.0)
    assert 'does not answer' in task.error
    assert said == [task.error]
    assert task.result is None


def test_a_dongle_that_is_pulled_out_ends_it_and_the_robot_stops_by_itself():
    bench = Bench()

    def pull(bench):
        if bench.board.counters[1] > 1000 and bench.emulator.port_open:
            bench.emulator.inject('close_port', 1000.0)

    bench.each = pull
    task, _ = bench.turn(jog.RIGHT, 5.0)
    assert 'not there' in task.error
    bench.emulator.run_to(bench.now_ns + 1_000_000_000)
    assert bench.board.speeds == (0, 0)
    assert bench.board.status & StatusFlag.TTL_EXPIRED


# -- the program ----------------------------------------------------------------------------------


@pytest.fixture
def ports(tmp_path):
    """Yield the paths of both ports of an emulator that runs as a process."""
    dongle, robot = tmp_path / 'dongle', tmp_path / 'robot'
    command = [sys.executable, '-m', 't3mpc_ros.cli.emulator', '--link', str(dongle)]
    child = subprocess.Popen(
        [*command, '--robot-link', str(robot)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)},
    )
    assert any('own USB' in line for line in child.stdout)
    yield str(dongle), str(robot)
    child.send_signal(signal.SIGTERM)
    said, _ = child.communicate(timeout=20)
    assert said.endswith('t3mpc emulator: stopped\n')
    assert 'Traceback' not in said
    assert not dongle.is_symlink()
    assert not robot.is_symlink()


@pytest.mark.slow
def test_a_new_robot_on_the_bench_from_key_to_wheel(ports, tmp_path, capsys):
    """Over pseudo terminals on the wall clock, as a person would do it."""
    dongle, robot = ports
    key = str(tmp_path / 'key')

    def run(*arguments):
        code = robot.main(arguments)
        said = capsys.readouterr()
        return code, said.out + said.err

    assert run('key', 'new', key)[0] == 0
    assert run('key', 'new', key)[0] == 2
    check = f'{key_check(read_key(tmp_path / "key")):08x}'
    assert check in run('key', 'check', key)[1]
    assert 'no key' in run('key', 'state', '--port', robot)[1]
    code, said = run('key', 'write', key, '--port', robot)
    assert (code, check in said) == (0, True)
    assert run('key', 'state', '--port', robot, '--key', key)[0] == 0
    code, said = run('key', 'write', key, '--port', dongle)
    assert (code, 'this is the dongle' in said) == (2, True)
    code, said = run('parameters', '--port', dongle)
    assert (code, 'give the host the key' in said) == (2, True)
    code, said = run('parameters', '--port', dongle, '--key', key, '--set', 'robot.idle_off=5')
    assert (code, 'ttl_max' in said, '5000' in said) == (0, True, True)
    assert 'robot answers by radio' in run('ping', '--port', dongle, '--count', '20')[1]
    code, said = run('scan', '--port', dongle)
    assert (code, 'channel 82 at 1M' in said) == (0, True)
    code, said = run('jog', 'left', '0.2', '--port', dongle, '--key', key, '--yes')
    assert (code, '640 wanted' in said) == (0, True)

    # Ctrl-C in mid-turn: the robot stands, then the program ends.
    threading.Timer(4.0, os.kill, (os.getpid(), signal.SIGINT)).start()
    begun = time.monotonic()
    code, said = run('jog', 'left', '90', '--port', dongle, '--key', key, '--yes')
    assert code == 130
    assert time.monotonic() - begun < 60.0
    assert 'interrupted' in said
    assert run('key', 'forget', '--port', robot)[0] == 0


def test_errors_of_the_port_are_words_with_a_remedy(tmp_path, capsys):
    missing = str(tmp_path / 'nothing')
    for command in (['ping'], ['scan'], ['parameters'], ['jog', 'left', '1', '--yes']):
        assert robot.main([*command, '--port', missing]) == 2
        assert 'is the dongle plugged in?' in capsys.readouterr().err
    assert robot.main(['key', 'state', '--port', missing]) == 2
    assert "is the robot's board plugged in?" in capsys.readouterr().err
    master, slave = os.openpty()
    path = os.ttyname(slave)
    holder = robot.run_at_port.__globals__['Port'](path)
    assert robot.main(['ping', '--port', path]) == 2
    assert 'another program has it open' in capsys.readouterr().err
    holder.close()
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize(
    'arguments, words',
    [
        (['ping', '--port', 'x', '--set', 'channel=126'], 'channel'),
        (['ping', '--port', 'x', '--set', 'chanel=12'], 'chanel'),
        (['scan', '--port', 'x', '--set', 'rate'], 'NAME=VALUE'),
        (['jog', 'left', '1', '--port', 'x', '--key', 'no/such/file', '--yes'], 'no/such/file'),
        (['jog', 'left', '1', '--port', 'x'], '--yes'),
        (['key', 'check', 'no/such/file'], 'no/such/file'),
    ],
)
def test_what_cannot_be_done_is_said_before_a_port_is_opened(
    arguments, words, capsys, monkeypatch
):
    with open(os.devnull) as nobody:
        monkeypatch.setattr(sys, 'stdin', nobody)
        assert robot.main(arguments) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize('answer', ['no', '', 'yeah', 'ctrl-c'])
def test_a_wheel_turns_only_if_a_person_says_yes(answer, capsys, monkeypatch):
    """Reading a line goes on after a signal: the question must hear Ctrl-C by itself."""
    opened = []
    monkeypatch.setattr(robot, 'carry_out', lambda *arguments: opened.append(arguments))
    master, slave = os.openpty()
    with open(slave) as terminal:
        monkeypatch.setattr(sys, 'stdin', terminal)
        if answer == 'ctrl-c':
            threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        else:
            os.write(master, answer.encode() + b'\n')
        code = robot.main(['jog', 'left', '1', '--port', 'x'])
        assert code == (130 if answer == 'ctrl-c' else 2)
        assert opened == []
        os.write(master, b'yes\n')
        assert robot.main(['jog', 'left', '1', '--port', 'x']) == 0
    os.close(master)
    assert len(opened) == 1
    said = capsys.readouterr()
    assert 'in the air' in said.out
    assert 'nothing was moved' in said.err


def test_a_file_of_zeros_is_no_key(tmp_path, capsys):
    path = tmp_path / 'key'
    path.write_text(32 * '0')
    path.chmod(0o600)
    assert robot.main(['key', 'write', str(path), '--port', 'x']) == 2
    assert 'zeros' in capsys.readouterr().err


@pytest.mark.parametrize(
    'arguments',
    [
        ['jog', 'left', '0', '--port', 'x'],
        ['jog', 'middle', '1', '--port', 'x'],
        ['jog', 'left', '1', '--speed', '11', '--port', 'x'],
        ['ping', '--count', '0', '--port', 'x'],
        ['ping'],
        ['key'],
        [],
    ],
)
def test_wrong_arguments_are_usage_errors(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        robot.main(arguments)
    assert ended.value.code == 2
    capsys.readouterr()
