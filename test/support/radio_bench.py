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
"""Scripted dongle and robot in virtual time, with faults by name, for tests of the link."""

import math
import random

from support.emulator_bench import MS, START_NS, Bench
from support.firmware_core import CoreVerifier
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import decode_downlink, decode_to_dongle, encode
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame

STEP = math.tau / 3200
WRAP = 1 << 32


def signed32(value):
    return (value + WRAP // 2) % WRAP - WRAP // 2


class FakeRobot:
    """Simplified rules of the robot: sequence, TTL, emergency stop, parameters; real sessions.

    Wheels reach the commanded speed at once and keep it between packets.
    """

    def __init__(self, key=b''):
        self.key = key
        self.skew = 0.0
        self.boots = 0
        self.refuses = {}
        self.rejects_commands = False
        self.button = False
        self.boot(0)

    def boot(self, now_ns, clock_us=0, steps=(0, 0)):
        self.boots += 1
        self.verifier = CoreVerifier(self.key)
        self.booted_ns, self.clock_us = now_ns, clock_us
        self.steps = [float(steps[0]), float(steps[1])]
        self.parameters = [parameter.default for parameter in frames.BOARD_PARAMETERS]
        self.parameters[-1] = self.boots
        self.speeds = (0.0, 0.0)
        self.enabled = self.estop = self.expired = False
        self.seq, self.last_seq = 0, None
        self.command_ns, self.until_ns = None, None
        self.reached_ns = now_ns
        self.answer = None
        self.refusal = frames.RefusalReason.NONE
        self.log = []

    def time_us(self, now_ns):
        return int((now_ns - self.booted_ns) / 1000 * (1.0 + self.skew) + self.clock_us) % WRAP

    settings = frames.SETTINGS_GOOD  # state of the settings in INFO

    def run_to(self, now_ns):
        end = now_ns if self.until_ns is None else min(max(self.until_ns, self.reached_ns), now_ns)
        for wheel in (0, 1):
            self.steps[wheel] += self.speeds[wheel] * (end - self.reached_ns) / 1e9 / STEP
        if self.until_ns is not None and now_ns >= self.until_ns:
            self.expired |= self.speeds != (0.0, 0.0)
            self.speeds, self.until_ns = (0.0, 0.0), None
        self.reached_ns = now_ns

    @property
    def angles(self):
        """Right and left wheel angle since the last start, rad."""
        return self.steps[1] * STEP, self.steps[0] * STEP

    def status(self):
        flags = {
            frames.StatusFlag.ENABLED: self.enabled,
            frames.StatusFlag.MOVING: self.speeds != (0.0, 0.0),
            frames.StatusFlag.ESTOP: self.estop,
            frames.StatusFlag.TTL_EXPIRED: self.expired,
            frames.StatusFlag.NO_SESSION: not self.verifier.session,
        }
        return sum((flag for flag, is_set in flags.items() if is_set), frames.StatusFlag(0))

    def state(self, now_ns):
        self.run_to(now_ns)
        age = frames.AGE_NONE
        if self.command_ns is not None:
            age = min(round((now_ns - self.command_ns) / 10_000 * (1.0 + self.skew)), 0xFFFE)
        left, right = (signed32(math.floor(steps)) for steps in self.steps)
        ranges = bytes([0, 1, 20, 100, 160, 254, 255, 60])
        session, status = self.verifier.session, self.status()
        motion = self.time_us(now_ns), left, right, 655, 16384, -8192
        return frames.State(session, self.seq, status, *motion, age, ranges)

    def receive(self, data, now_ns):
        """Process a packet."""
        self.run_to(now_ns)
        frame = decode_downlink(data)
        self.log.append((now_ns, frame))
        self.answer = None
        if isinstance(frame, frames.Hello):
            nonce = self.boots.to_bytes(4, 'little') + self.time_us(now_ns).to_bytes(4, 'little')
            self.refusal = self.verifier.begin_session(frame, nonce)
            if not self.refusal:
                self.last_seq, self.seq, self.speeds, self.enabled = None, 0, (0.0, 0.0), False
            self.answer = self.info(frame.seq, now_ns)
        elif isinstance(frame, frames.Poll):
            if frame.what == frames.INFO:
                self.answer = self.info(frame.seq, now_ns)
            elif frame.what == frames.AUX:
                counts = 11100, 0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7
                head = self.verifier.session, 0, self.status()
                self.answer = frames.Aux(*head, *counts, self.refusal, bytes(3))
        elif isinstance(frame, frames.ParamGet):
            self.answer = self.parameter(frame, frames.OK)
        elif not (refusal := self.verifier.verify(frame)):
            if isinstance(frame, frames.Command):
                self.follow(frame, now_ns)
            elif isinstance(frame, frames.ParamSet):
                self.set(frame)
            else:
                busy = self.speeds != (0.0, 0.0)
                rc = frames.BUSY if busy else frames.OK
                if frame.verb == frames.RESET_ODOMETRY and not busy:
                    self.steps = [0.0, 0.0]
                self.answer = frames.Ack(self.verifier.session, frame.seq, frame.verb, rc)
        else:
            self.refusal = refusal

    def info(self, seq, now_ns):
        count, nonce = len(frames.BOARD_PARAMETERS), self.verifier.nonce
        identity = frames.VERSION, 2, 0, 2, count, 200, 16, self.refusal, self.settings
        return frames.Info(self.verifier.session, seq, *identity, 82, b'T3MPC', 0, nonce)

    def parameter(self, frame, rc):
        row = frames.BOARD_PARAMETERS[frame.id]
        value = self.parameters[frame.id]
        return frames.Param(
            self.verifier.session, frame.seq, frame.id, rc, value, row.low, row.high
        )

    def set(self, frame):
        rc = self.refuses.get(frame.id, frames.OK)
        if rc == frames.OK:
            self.parameters[frame.id] = frame.value
        self.answer = self.parameter(frame, rc)

    def follow(self, frame, now_ns):
        if frame.flags & frames.CommandFlag.ESTOP:
            self.estop, self.enabled, self.speeds = True, False, (0.0, 0.0)
            return
        if self.rejects_commands:
            self.refusal = frames.RefusalReason.SEQUENCE
            return
        ttl_ms = min(10 * frame.ttl, self.parameters[3])
        if (self.time_us(now_ns) - frame.echo_us) % WRAP >= 1000 * ttl_ms + 50_000:
            self.refusal = frames.RefusalReason.STALE
            return
        if self.last_seq is not None and not 0 < (frame.seq - self.last_seq) % 256 < 128:
            return
        self.last_seq = self.seq = frame.seq
        self.command_ns = now_ns
        if frame.flags == frames.CommandFlag.ESTOP_CLEAR and not self.button:
            self.estop = False
        self.expired = False
        self.enabled = bool(frame.flags & frames.CommandFlag.ENABLE) and not self.estop
        wanted = (frame.left / 1000.0, frame.right / 1000.0) if self.enabled and ttl_ms else (0, 0)
        self.speeds = (float(wanted[0]), float(wanted[1]))
        self.until_ns = now_ns + ttl_ms * MS


class FakeDongle:
    """Answers each frame after its real duration; faults are attributes and methods.

    It has the interface of the emulator.
    """

    def __init__(self, robot, seed=1):
        self.robot = robot
        self.source = random.Random(seed)
        self.parameters = None
        self.chip_ok = True
        self.version = frames.VERSION
        self.loss = 0.0
        self.jam_until_ns = 0
        self.drop_replies = 0
        self.busy = 0
        self.jitter_ns = 0
        self.requests = []
        self.boot_delay_ns = 0
        self.change = lambda reply: reply  # returns what is sent in place of a reply
        self.board, self.now_ns = robot, START_NS
        self.port_open, self.replies = True, []
        self.restart(0)

    def restart(self, now_ns):
        """Restart: the configuration is lost, and the boot loader runs."""
        self.started_ns = now_ns
        self.ready_ns = now_ns + self.boot_delay_ns
        self.decoder = FrameDecoder()
        self.configured = False
        self.radio = 82, b'T3MPC'

    def time_us(self, now_ns):
        return (now_ns - self.started_ns) // 1000 % WRAP

    def is_received(self, now_ns):
        """Whether a packet is received without retransmission."""
        return (
            self.configured
            and self.chip_ok
            and now_ns >= self.jam_until_ns
            and self.source.random() >= self.loss
        )

    @property
    def next_ns(self):
        return self.replies[0][0] if self.replies else None

    def feed(self, data, now_ns):
        self.replies = sorted(self.replies + self.receive(data, now_ns))

    def run_to(self, now_ns):
        self.now_ns = now_ns
        due = [reply for reply in self.replies if reply[0] <= now_ns]
        del self.replies[: len(due)]
        return due

    def receive(self, data, now_ns):
        """Return (time, bytes) of each reply."""
        if now_ns < self.ready_ns:
            return []
        replies = []
        for frame in self.decoder.feed(data):
            at, reply = self.reply(decode_to_dongle(frame), now_ns + len(data) * 20_000)
            if self.drop_replies:
                self.drop_replies -= 1
                continue
            at += self.source.randrange(self.jitter_ns + 1)
            replies.append((at, encode_frame(encode(self.change(reply)))))
        return replies

    def reply(self, frame, now_ns):
        if isinstance(frame, frames.Ping):
            state = self.time_us(now_ns), self.version, 2, 0, int(self.chip_ok)
            counts = *self.decoder.counts[1:], 0, 2, 0
            pong = frames.Pong(frame.id, frame.echo, *state, *counts, *self.radio, 0)
            return now_ns + MS, pong
        if isinstance(frame, frames.Configure):
            self.configured = True
            self.radio = frame.channel, frame.address
            return now_ns + MS, frames.Configured(*frame, int(self.chip_ok))
        if self.busy:
            self.busy -= 1
            return now_ns + MS, frames.Refusal(3, frame.id)
        return self.transact(frame, now_ns)

    def transact(self, frame, now_ns):
        clock = self.time_us(now_ns + 4 * MS)
        self.requests.append((now_ns, decode_downlink(frame.first)))
        if not self.is_received(now_ns):
            return now_ns + 3 * MS, frames.Result(frame.id, 0x34, 0x08, clock)
        robot = self.robot
        robot.receive(frame.first, now_ns + 445_000)
        first, second = 0x03, 0x03
        # The first packet fetches an older STATE.
        payload = encode(robot.state(now_ns + 445_000))
        if self.source.random() >= self.loss:
            answer = robot.answer or robot.state(now_ns + 1_245_000)
            payload = encode(answer)
            robot.receive(frame.second, now_ns + 2 * MS)
        else:
            second = 0x34
        return now_ns + 3 * MS, frames.Result(frame.id, first, second, clock, payload)


class LinkBench(Bench):
    """Runs a link against the scripted dongle and robot in virtual time."""

    def __init__(self, parameters=None, key=b'', robot=None, seed=1, robot_key=None):
        self.robot = robot or FakeRobot(key if robot_key is None else robot_key)
        self.dongle = FakeDongle(self.robot)
        super().__init__(key=key, link=parameters, seed=seed, emulator=self.dongle)

    def unplug(self):
        """Unplug the dongle: the next use of the port fails."""
        self.dongle.port_open = False
        self.dongle.replies.clear()

    def plug(self):
        """Plug the dongle in; it restarts."""
        self.dongle.port_open = True
        self.dongle.restart(self.now_ns)
