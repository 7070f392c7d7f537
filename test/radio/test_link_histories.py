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
"""What a robot may do, and what is said about it, after any history of the link."""

import random

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
import pytest
from support.emulator_bench import MS
from support.properties import STATEFUL
from support.radio_bench import LinkBench

from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.actions_and_states import LinkState
from t3mpc_ros.radio.link.link_parameters import TTL_UNIT_NS, LinkParameters
from t3mpc_ros.radio.link.setpoint_arbitration import SetpointArbiter
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.frames import CommandFlag

KEY = bytes(range(16))
PARAMETERS = LinkParameters()


class Arbiter(RuleBasedStateMachine):
    """Setpoints for a robot with a button, over a link that may be silent."""

    def __init__(self):
        super().__init__()
        self.made, self.now_ns = SetpointArbiter(PARAMETERS), 5_000_000_000
        self.reason, self.wheels, self.until_ns = reasons.NO_COMMAND, None, 0
        self.estop, self.latched, self.button, self.held = '', False, False, False
        self.released_ns, self.frames = None, 0

    @rule(right=st.floats(-40.0, 40.0), left=st.floats(-40.0, 40.0), ms=st.integers(1, 600))
    def command(self, right, left, ms):
        self.wheels, self.until_ns = WheelSpeeds(right, left), self.now_ns + ms * MS
        self.made.command(self.wheels, self.until_ns)

    @rule()
    def stop(self):
        self.wheels, self.reason = None, 'it is to stop'
        self.made.clear('it is to stop')

    @rule(text=st.sampled_from(['one', 'two']))
    def latch(self, text):
        self.made.latch(text)
        self.estop, self.released_ns = f'emergency stop: {text}', None
        self.wheels, self.reason = None, reasons.NO_COMMAND

    @rule()
    def release(self):
        problem = self.made.release(self.latched, self.now_ns)
        assert bool(problem) == (not self.estop and not self.latched)
        if not problem:
            self.estop, self.held, self.wheels = '', False, None
            self.released_ns, self.frames = self.now_ns, 0
            self.reason = 'no command since the emergency stop was released'

    @rule(pressed=st.booleans())
    def press(self, pressed):
        self.button = pressed
        self.latched |= pressed

    @rule(restarts=st.booleans())
    def hold_the_button_during_a_release(self, restarts):
        self.press(True)
        self.release()
        self.cycles(7, 200, True, False)
        if restarts:  # then another press is another stop
            self.press(False)
            self.restart()
            self.cycles(1, 20, True, False)
            self.press(True)

    @rule(cycles=st.integers(1, 3))
    def release_twice(self, cycles):
        """The second release is as long as the first one, which another stop has ended."""
        for count in (cycles, 4):
            self.latch('one')
            self.release()
            self.cycles(count, 20, True, False)

    @rule(off=st.sampled_from([-1, 0, 1]))
    def command_until_it_expires(self, off):
        self.command(5.0, -5.0, 100)
        self.now_ns = self.until_ns + off
        self.cycle(0, True, False)

    @rule()
    def restart(self):
        """The robot restarts: its latch is that of the button."""
        self.latched = self.button

    @rule(
        count=st.integers(1, 7),
        ms=st.integers(1, 400),
        arrives=st.booleans(),
        silent=st.booleans(),
    )
    def cycles(self, count, ms, arrives, silent):
        for _ in range(count):
            self.cycle(ms, arrives, silent)
            self.the_reason_is_the_present_one()

    def cycle(self, ms, arrives, silent):
        self.now_ns += ms * MS
        setpoint = self.made.next_setpoint(self.latched, self.now_ns, silent)
        moves = (setpoint.left, setpoint.right) != (0, 0)
        assert 1 <= setpoint.ttl <= PARAMETERS.ttl_units
        if self.wheels is not None and self.now_ns >= self.until_ns and not self.busy:
            self.wheels, self.reason = None, reasons.COMMAND_EXPIRED
        if not self.latched:
            self.held = False
        if self.estop:
            assert setpoint.flags == CommandFlag.ESTOP
            assert not moves
        elif self.busy:
            assert setpoint.flags == CommandFlag.ESTOP_CLEAR
            assert not moves
            self.frames += 1
        else:
            if self.released_ns is not None:
                self.released_ns, self.held = None, self.latched
            assert setpoint.flags == CommandFlag.ENABLE
            follows = self.wheels is not None and not self.latched and not silent
            wanted = self.wheels if follows else (0.0, 0.0)
            limit = PARAMETERS.robot.max_speed / max(1e-9, *map(abs, wanted))
            right, left = (round(1000.0 * min(1.0, limit) * each) for each in wanted)
            assert (setpoint.right, setpoint.left) == (right, left)
            assert self.made.sent_wheels == (right / 1000.0, left / 1000.0)
            left_ns = self.until_ns - self.now_ns
            assert not follows or setpoint.ttl * TTL_UNIT_NS <= max(left_ns, TTL_UNIT_NS)
        if arrives and setpoint.flags == CommandFlag.ESTOP:
            self.latched = True
        if arrives and setpoint.flags == CommandFlag.ESTOP_CLEAR and not self.button:
            self.latched = False

    @property
    def busy(self):
        """Whether a release is being sent: three times at least, a second at most."""
        if self.released_ns is None or self.estop:
            return False
        return self.frames < 3 or (self.latched and self.now_ns < self.released_ns + 1000 * MS)

    @invariant()
    def the_reason_is_the_present_one(self):
        held = reasons.ESTOP_BUTTON_HELD if self.held else reasons.ROBOT_ESTOP
        idle = '' if self.wheels is not None else self.reason
        wanted = self.estop or (held if self.latched else idle)
        assert self.made.reason(self.latched) == wanted
        assert self.made.estop == self.estop


TestArbiter = Arbiter.TestCase
TestArbiter.settings = settings(STATEFUL, max_examples=40)


class History(RuleBasedStateMachine):
    """A link with faults of every kind: motion needs a command after the last release."""

    @initialize(seed=st.integers(0, 2**16), key=st.sampled_from([b'', KEY]))
    def start(self, seed, key):
        self.bench = LinkBench(key=key, seed=seed)
        self.source = random.Random(seed)
        self.bench.dongle.boot_delay_ns = self.source.choice([0, 1500]) * MS
        self.may_move, self.checked, self.numbers = False, 0, []
        self.run(0.3)

    def run(self, seconds):
        self.bench.run(seconds)
        robot, link = self.bench.robot, self.bench.link
        moved = [
            frame
            for _, frame in robot.log[self.checked :]
            if isinstance(frame, frames.Command) and (frame.left, frame.right) != (0, 0)
        ]
        self.checked = len(robot.log)
        assert self.may_move or not moved
        number = link._session.number if link._session else None
        if number and self.numbers[-1:] != [number]:
            self.numbers.append(number)

    @rule(seconds=st.floats(0.05, 0.6))
    def wait(self, seconds):
        self.run(seconds)

    @rule(right=st.floats(1.0, 5.0), left=st.floats(-5.0, -1.0))
    def drive(self, right, left):
        self.bench.drive(right, left)
        self.may_move = not self.bench.link._arbiter.estop
        self.run(0.3)

    @rule()
    def stop(self):
        self.bench.release_controls()
        self.bench.link.stop('it is to stop')
        self.run(0.1)
        self.may_move = False

    @rule()
    def latch(self):
        self.bench.release_controls()
        self.bench.link.latch_estop('any reason')
        if self.bench.link.state is LinkState.RUN:
            self.bench.run(0.05)  # a frame on its way still arrives
            self.checked = len(self.bench.robot.log)
        self.may_move = False
        self.run(0.3)

    @rule()
    def release(self):
        self.bench.release_controls()
        self.run(0.05)
        if not self.bench.link.release_estop(self.bench.now_ns):
            self.may_move = False
        self.run(0.3)

    @rule(pressed=st.booleans())
    def press(self, pressed):
        self.bench.robot.button = pressed
        self.bench.robot.estop |= pressed
        self.run(0.3)

    @rule()
    def robot_restarts(self):
        self.bench.robot.boot(self.bench.now_ns, self.source.randrange(2**32))
        self.bench.robot.estop = self.bench.robot.button
        self.run(0.3)

    @rule()
    def dongle_restarts(self):
        """Its clock shows that, a second after its last start at the earliest."""
        self.run(1.3)
        self.bench.dongle.restart(self.bench.now_ns)
        self.run(0.3)

    @rule(there=st.booleans())
    def plug(self, there):
        if there != self.bench.dongle.port_open:
            (self.bench.plug if there else self.bench.unplug)()
        self.run(0.5)

    @rule(loss=st.sampled_from([0.0, 0.3, 1.0]))
    def lose(self, loss):
        self.bench.dongle.loss = loss
        self.run(0.5)

    @invariant()
    def what_is_said_is_so(self):
        if not hasattr(self, 'bench'):
            return
        link, now_ns = self.bench.link, self.bench.now_ns
        reason = link.reason(now_ns)
        running = link.state is LinkState.RUN
        fresh = running and not link.is_silent(now_ns) and link.telemetry is not None
        assert reason or running
        if not reason:
            status = link.telemetry.status
            assert (status.enabled, status.estop) == (True, False)
            assert not link._arbiter.estop
        if fresh:
            assert link._session.echo_us == link.telemetry.raw.time_us
            assert link.authenticated == bool(link._key)
        if running and reason.startswith('emergency stop'):
            assert link._arbiter.estop == reason
        if reason == reasons.ESTOP_BUTTON_HELD:
            assert link.telemetry.status.estop
        assert all(a != b for a, b in zip(self.numbers, self.numbers[1:], strict=False))

    def teardown(self):
        """Without the faults, the robot follows the next command after a release."""
        if not hasattr(self, 'bench'):
            return
        bench = self.bench
        bench.release_controls()
        bench.dongle.loss, bench.robot.button = 0.0, False
        bench.dongle.port_open or bench.plug()
        bench.run(20.0, lambda: bench.link.state is LinkState.RUN)
        bench.run(0.5)
        bench.link.release_estop(bench.now_ns)
        bench.run(1.0, lambda: not bench.robot.estop)  # up to 0.62 s after some histories
        bench.run(0.5)
        assert not bench.robot.estop
        bench.drive(2.0, 3.0)
        bench.run(0.5)
        assert bench.robot.speeds == pytest.approx((3.0, 2.0))
        assert bench.link.reason(bench.now_ns) == ''


TestHistory = pytest.mark.slow(History.TestCase)
TestHistory.settings = settings(STATEFUL, max_examples=8, stateful_step_count=15)
