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
"""Runs tasks of the bench tool at the ports of an emulator, in virtual time."""

import random

from t3mpc_ros.emulator.emulator import Emulator, EmulatorParameters
from t3mpc_ros.radio.link.actions_and_states import Close, Open, Wait, Write
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.tool import manoeuvre
from t3mpc_ros.radio.tool.procedure import DONGLE, ROBOT_BOARD, Procedure, ProcedureError

START_NS = 5_000_000_000


class ToolBench:
    """Runs a task at one of the two ports of an emulator, in virtual time."""

    def __init__(self, key=b'', seed=1, erased=False, emulator=None, **flat):
        if emulator is None:
            parameters = EmulatorParameters.from_dict(flat)
            emulator = Emulator(parameters, key, seed, START_NS, erased)
        self.emulator = emulator
        self.now_ns = emulator.now_ns
        self.each = None

    @property
    def board(self):
        return self.emulator.board

    def run(self, task, robot=False, seconds=120.0):
        """Run a task at the port of the dongle, or of the robot; return it."""
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

    def _do(self, task, actions, robot):
        wake = self.now_ns
        for action in actions:
            if isinstance(action, Wait):
                wake = action.until_ns
            elif isinstance(action, Open):
                self.is_open = True
                task.port_opened(self.now_ns)
                return self.now_ns
            elif isinstance(action, Write) and self.is_open and robot:
                self.emulator.feed_console(action.data, self.now_ns)
            elif isinstance(action, Write) and self.is_open:
                self.emulator.feed(action.data, self.now_ns)
            elif isinstance(action, Close):
                self.is_open = False
        return wake

    def wait(self, seconds):
        """Leave the robot alone for a while."""
        end = self.now_ns + round(1e9 * seconds)
        while self.now_ns < end:
            self.now_ns = min(end, self.now_ns + 10_000_000)
            self.emulator.run_to(self.now_ns)
            if self.each is not None:
                self.each(self)

    def at_dongle(self, script, board=DONGLE):
        """Return the result of a script, for this board or another, at the port of the dongle."""
        return self._result(self.run(Procedure(script, board.decode)))

    def at_robot(self, script):
        """Return the result of a script at the USB port of the robot board."""
        return self._result(self.run(Procedure(script, ROBOT_BOARD.decode), robot=True))

    def _result(self, procedure):
        if procedure.error:
            raise ProcedureError(procedure.error)
        return procedure.result

    def radio(self):
        """Return the radio configuration of the dongle."""
        return self.emulator.dongle.radio

    def jog(self, wheel, revolutions, key=b'', speed=2.0, link=None):
        reported = []
        task = manoeuvre.Jog(
            link or LinkParameters(),
            key,
            random.Random(1).randbytes,
            wheel,
            revolutions,
            speed,
            reported.append,
        )
        self.run(task)
        return task, reported
