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
"""Golden bags: short closed-loop runs, recorded as by the nodes, which replay bit-equal.

    PYTHONPATH=. .venv/bin/python test/support/golden_bags.py

records those of ``test/golden`` anew, with the current controller.
"""

from dataclasses import dataclass, field
import math
from pathlib import Path
import tempfile
import zlib

import numpy as np

from t3mpc_ros.bag.controller_input_journal import Journal, parameters_to_json
from t3mpc_ros.control.controller import SCALAR_NAMES, Controller, StepperControllerParameters
from t3mpc_ros.evaluation.process_replay.controller_inputs import CONTROLLER, FIELDS
from t3mpc_ros.evaluation.process_replay.controller_replay import (
    LATER,
    PARAMETERS,
    ControllerBag,
    output_row,
)
from t3mpc_ros.evaluation.run_record import RATE
from t3mpc_ros.evaluation.scenario import LEAD, Scenario, noisy_twin
from t3mpc_ros.evaluation.topic_roles import COMMAND, JOURNAL, ODOMETRY, REFERENCE
from t3mpc_ros.geometry.kinematics import twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import NANOSECONDS, ORIGIN, STANDSTILL, BodyTwist, State, WheelSpeeds
from t3mpc_ros.model_file import load_model
from t3mpc_ros.robot.interface import RobotCommand
from t3mpc_ros.simulation.digital_twin import DigitalTwin
from t3mpc_ros.simulation.fault_schedule import FaultEvent, FaultSchedule

GOLDEN = Path(__file__).resolve().parents[1] / 'golden'


class RecordedController:
    """A controller whose inputs and outputs are written to a bag, as by node and recorder.

    Every event has its time, which must not decrease. ``every`` is how many steps lie between two
    publications of its scalars; ``model`` is the file to start from; ``obstacles`` are those that
    its keep-out knows.
    """

    def __init__(self, parameters, bag, now_ns, every=5, model=None, obstacles=None):
        self._bag, self._every, self._steps = bag, every, 0
        self._journal = Journal()
        self.controller = Controller(parameters, obstacles)
        self.controller.warm_up()
        bag.add(PARAMETERS, now_ns, parameters_to_json(0, parameters.to_dict()))
        if model is not None:
            self.controller.set_weights(load_model(model))
            bag.add(JOURNAL, now_ns, self._journal.model(zlib.crc32(model.read_bytes())))

    def add_reference(self, now_ns, motion):
        """Pass a reference to the controller."""
        self._bag.add(REFERENCE, now_ns, motion)
        self._journal.count_reference(motion.stamp_ns)
        self.controller.add_reference(motion)

    def step(self, now_ns, measured):
        """Return the command for one odometry message."""
        self._bag.add(ODOMETRY, now_ns, measured)
        command, status = self.controller.step(measured)
        self._bag.add(COMMAND, now_ns + LATER, command)
        self._bag.add(JOURNAL, now_ns + 2 * LATER, self._journal.step(measured.stamp_ns))
        self._steps += 1
        if self._steps % self._every == 0:
            for name, value in zip(FIELDS, output_row(command, status), strict=True):
                if name in SCALAR_NAMES and math.isfinite(value):
                    self._bag.add(f'{CONTROLLER}/{name}', now_ns + 3 * LATER, value)
        return command

    def step_without_odometry(self, now_ns):
        """Pass an instant in a gap of the odometry."""
        found = self.controller.step_without_odometry(now_ns)
        if found is not None:
            self._bag.add(COMMAND, now_ns + LATER, found[0])
            self._bag.add(JOURNAL, now_ns + 2 * LATER, self._journal.step_without_odometry(now_ns))

    def add_range(self, now_ns, sensor, reading):
        """Pass a range reading (m) to the controller."""
        self._bag.add(JOURNAL, now_ns, self._journal.range(sensor, reading))
        self.controller.add_range(sensor, reading)

    def time_out(self, now_ns):
        """Handle missing odometry: stop."""
        self.controller.check_odometry(None, now_ns)
        self._bag.add(COMMAND, now_ns, STANDSTILL)
        row = self._journal.odometry_timeout(self.controller.status.stamp_ns)
        self._bag.add(JOURNAL, now_ns + LATER, row)

    def enable(self, now_ns, on):
        """Enable or disable motion."""
        self.controller.enable(on)
        self._bag.add(JOURNAL, now_ns, self._journal.enable(on))

    def reset(self, now_ns):
        """Reset the controller."""
        self.controller.reset()
        self._bag.add(JOURNAL, now_ns, self._journal.reset())

    def configure(self, now_ns, changes):
        """Apply other dynamic parameters."""
        parameters = self.controller.parameters.with_values(changes)
        self.controller.configure(parameters)
        row = self._journal.configure()
        text = parameters_to_json(self._journal.revision, parameters.to_dict())
        self._bag.add(PARAMETERS, now_ns, text)
        self._bag.add(JOURNAL, now_ns, row)

    def finish(self, now_ns):
        """Publish the final stop."""
        self._bag.add(COMMAND, now_ns, STANDSTILL)
        self._bag.add(JOURNAL, now_ns + LATER, self._journal.finish())


START_NS = 1_700_000_000 * NANOSECONDS
RECEIPT_DELAY = 500_000
"""ns from the stamp of an odometry message to its arrival at the controller."""
WATCHDOG_PERIOD = 0.05  # s between two checks of the odometry watchdog
NEVER = (math.inf, math.inf)


@dataclass(frozen=True)
class GoldenScenario:
    """One golden run."""

    seed: int  # seed of reference and robot
    stretches: tuple
    """Intervals in which the reference is followed, s; it switches every 12 s and between them."""
    actions: dict = field(default_factory=dict)
    """By time (s): ``enable`` (bool), ``reset`` (nothing), ``configure`` (changes)."""
    faults: tuple = ()
    quiet_reference: tuple = NEVER  # interval without reference, s
    quiet_odometry: tuple = NEVER  # interval without odometry, s
    bad_odometry: tuple = ()  # times of odometry messages that are not finite, s
    parameters: dict = field(default_factory=dict)
    """Parameters of the controller other than those of the stepper robot's."""


GOLDEN_SCENARIOS = {
    'switches': GoldenScenario(2, ((9.5, 14.0), (22.5, 27.4))),
    'stops': GoldenScenario(
        4,
        ((3.0, 12.4),),
        {1.5: ('enable', False), 2.0: ('enable', True), 6.5: ('reset',)},
        quiet_reference=(3.0, 3.7),
        quiet_odometry=(4.5, 5.0),
        bad_odometry=(5.8, 5.81),
    ),
    'changes': GoldenScenario(
        6,
        ((8.0, 17.4),),
        {
            1.5: ('configure', {'law.gain': 20.0}),
            2.5: ('configure', {'law.compensator': False, 'adaptation.gamma': 300.0}),
            3.5: ('configure', {'use_fuzzy': False}),
            4.5: ('configure', {'linear.x.max_velocity': 0.15, 'use_fuzzy': True}),
            5.5: (
                'configure',
                {'jump_transition.preview': False, 'predictive.move_weight': 0.01},
            ),
        },
        (
            FaultEvent(2.0, 'load_change', 0.5, 3.0),
            FaultEvent(4.0, 'slippery', 0.3, 1.5),
            FaultEvent(6.0, 'command_delay', 0.03, 1.0),
            FaultEvent(7.5, 'brown_out', True, 0.1),
        ),
        parameters={'composition': 'paper'},
    ),
}
"""Golden runs by the name of their file."""


def run_golden_scenario(scenario, folder):
    """Return the bag file of a run in ``folder``; equal scenarios give equal messages."""
    parameters = StepperControllerParameters().with_values(scenario.parameters)
    robot = DigitalTwin(noisy_twin(seed=scenario.seed), FaultSchedule(scenario.faults))
    whole = (
        Scenario('servo', 'nominal', scenario.seed, scenario.stretches[-1][1]).reference().speeds
    )
    course = np.concatenate(
        [whole[round(begin * RATE) : round(end * RATE)] for begin, end in scenario.stretches]
    )
    lead = round(LEAD * RATE)
    with ControllerBag(folder, parameters) as bag:
        loop = _Loop(scenario, RecordedController(parameters, bag, START_NS, every=10))
        for k in range(lead):
            loop.reference(k, 0, course[k].tolist())
        for k in range(len(course) - lead):
            loop.reference(k + lead, k, course[k + lead].tolist())
            state = robot.advance(_stamp(k))
            robot.apply(loop.step(k, state.odometry), state.stamp_ns)
        loop.finish()
        return bag.path


class _Loop:
    """Executes a scenario in virtual time."""

    def __init__(self, scenario, recorded):
        self._scenario, self._recorded = scenario, recorded
        self._actions = dict(scenario.actions)
        self._geometry = recorded.controller.parameters.geometry
        self._received = self._checked = 0.0
        self._now_ns = START_NS
        self._command = RobotCommand(WheelSpeeds(0.0, 0.0), 0)

    def reference(self, k, now, wheels):
        """Pass sample ``k`` of the reference at period ``now``."""
        begin, end = self._scenario.quiet_reference
        if not begin <= now / RATE < end:
            twist = twist_from_wheels(WheelSpeeds(*wheels), self._geometry)
            motion = State(START_NS + _stamp(k), ORIGIN, twist)
            self._recorded.add_reference(self._later(now), motion)

    def step(self, k, odometry):
        """Return the newest command."""
        now, scenario = k / RATE, self._scenario
        for when in [when for when in self._actions if when <= now]:
            name, *values = self._actions.pop(when)
            getattr(self._recorded, name)(self._later(k), *values)
        begin, end = scenario.quiet_odometry
        if begin <= now < end:
            self._check_odometry(k, now)
            return self._command
        if now in scenario.bad_odometry:
            odometry = State(odometry.stamp_ns, odometry.pose, BodyTwist(math.nan, 0.0))
        measured = State(START_NS + odometry.stamp_ns, odometry.pose, odometry.twist)
        twist = self._recorded.step(self._later(k) + RECEIPT_DELAY, measured)
        self._received = now
        self._command = RobotCommand(wheels_from_twist(twist, self._geometry), odometry.stamp_ns)
        return self._command

    def finish(self):
        """End the run."""
        self._recorded.finish(self._now_ns + NANOSECONDS // 100)

    def _check_odometry(self, k, now):
        """Check for missing odometry, as the node does periodically."""
        timeout = self._recorded.controller.parameters.watchdog.odometry_timeout
        if now - self._received > timeout and now - self._checked > WATCHDOG_PERIOD - 1e-9:
            self._checked = now
            self._recorded.time_out(self._later(k))
            self._command = self._command._replace(wheels=WheelSpeeds(0.0, 0.0))

    def _later(self, k):
        """Return the time of period ``k``, slightly later with each call."""
        self._now_ns = max(START_NS + _stamp(k), self._now_ns + 1000)
        return self._now_ns


def _stamp(k):
    return round(k * NANOSECONDS / RATE)


if __name__ == '__main__':
    for stem, golden in GOLDEN_SCENARIOS.items():
        path = GOLDEN / f'{stem}.mcap'
        with tempfile.TemporaryDirectory(dir=GOLDEN) as scratch:
            run_golden_scenario(golden, Path(scratch)).replace(path)
        print(f'{path}: {path.stat().st_size} bytes')
