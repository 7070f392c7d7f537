# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Robot board firmware: the reaction to each radio payload and to silence (docs/radio.md).

Nothing moves before HELLO and ENABLE. A command is valid for its TTL from reception; on expiry
the wheels ramp down. The newest command replaces the previous one; nothing is queued. An emergency
stop is accepted from any sender. The main loop runs every 200 us, as on the host build of the core.
"""

from collections.abc import Callable

from t3mpc_ros.emulator.board import uplink
from t3mpc_ros.emulator.board.console import Console, KeyStore
from t3mpc_ros.emulator.board.hardware import Hardware, Registers
from t3mpc_ros.emulator.board.motion import Wheels
from t3mpc_ros.emulator.board.parameter_store import (
    BATTERY_LOW,
    INVERT_WHEELS,
    MAX_SPEED,
    MICROSTEPS,
    STEPS_PER_REV,
    TTL_MAX,
    ParameterStore,
)
from t3mpc_ros.emulator.board.uplink import PacketCounters, PendingReply
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.authentication import NONCE_SIZE
from t3mpc_ros.radio.protocol.clock_sync import wrapped_difference
from t3mpc_ros.radio.protocol.codec import decode_downlink, encode, is_estop_command
from t3mpc_ros.radio.protocol.frames import (
    BOARD_PARAMETERS,
    PAYLOAD_LIMIT,
    Action,
    Command,
    CommandFlag,
    FrameError,
    FrameErrorKind,
    Hello,
    ParamGet,
    ParamSet,
    Poll,
    StatusFlag,
    Uplink,
)

WINDOW_US = 5_000_000
SLACK_US = 50_000
"""Two clocks of 0.5 % drift apart by so much within two windows."""
_COUNTER_RANGE = 1 << 32


class StaleCommandFilter:
    """Decides whether a message is stale.

    The delay of the fastest message within the last 5 to 10 s counts as the ordinary one; what
    takes longer than that by the TTL and the slack is stale. Windows change only when a message
    comes: after a silence the old minimum still finds what was held all the while.
    """

    def __init__(self, received_us: int, host_us: int) -> None:
        self._since = self._before_since = received_us
        self._least = self._before_least = (received_us - host_us) % _COUNTER_RANGE

    def is_stale(self, received_us: int, host_us: int, ttl_us: int) -> bool:
        """Take the stamps of a message (us) and decide."""
        delay = (received_us - host_us) % _COUNTER_RANGE
        if received_us - self._since >= WINDOW_US:
            self._before_since, self._before_least = self._since, self._least
            self._since, self._least = received_us, delay
        elif wrapped_difference(delay, self._least) > 0:
            self._least = delay
        least = self._before_least
        if wrapped_difference(self._least, least) > 0:
            least = self._least
        # After a silence the clocks have drifted further: 0.5 % of it, as in the slack.
        silence = max(received_us - self._before_since - 2 * WINDOW_US, 0)
        return wrapped_difference(least, delay) > ttl_us + SLACK_US + silence // 200


LOOP_US = 200
SETTLE_US, SETTLE_SLOW_US = 600, 1600
"""Until the acknowledgement of the packet before is off the air; the second at 250 kbit/s."""
REFRESH_US = 100_000
"""Nobody asks: what waits in the radio is made anew so often."""
SESSION_TIMEOUT_US = 1_800_000_000
"""A session ends after so long: beyond it, clocks of 32 bits become ambiguous."""
STEP_RATE = 10_000
"""Most microsteps a second of a wheel: one for two ticks of a 20 kHz interrupt."""
_TURN = 6_283_185.3071795865
"""A revolution, urad."""


class RobotBoard:
    """The firmware of the robot.

    Parameters
    ----------
    hardware
        What it drives and reads.
    key
        16 bytes; empty for an open link.
    entropy
        Returns that many bytes nobody can foresee, for nonces.
    load
        Puts a payload where the next packet fetches it.
    settle_us
        From a packet to its answer.
    """

    def __init__(
        self,
        hardware: Hardware,
        key: bytes,
        entropy: Callable[[int], bytes],
        load: Callable[[bytes], None],
        settle_us: int = SETTLE_US,
    ) -> None:
        self._hardware = hardware
        self.slot = KeyStore(key)
        """Where the key is kept."""
        self._entropy = entropy
        self._load_payload = load
        self._settle_us = settle_us
        self._values = ParameterStore()
        self.button = False
        """Whether the emergency stop is pressed."""
        self.followed: Callable[[int, Command], None] = lambda now_us, command: None
        """Told of each command that the wheels are to follow, and when; for tests and traces."""
        self.console = Console(self)
        """What answers on the USB of the board."""
        self._now = 0
        self.boot(1)

    def boot(self, reset_cause: int, time_us: int = 0) -> None:
        """Start at rest, drivers without power, no session; what was in RAM is gone."""
        self.slot.cut(self._now)
        self._now = self._booted = time_us
        self.reset_cause = reset_cause
        """As the MCUSR of an AVR has it."""
        self.gate = self.slot.gate()
        self.console.restart()
        self._values.restart()
        self._microsteps = self._values[MICROSTEPS]
        steps = self._values[STEPS_PER_REV] * self._microsteps
        self._top_speed = int(STEP_RATE * _TURN / steps / 1000)
        self._counts = PacketCounters()
        self._wheels = Wheels(self._hardware, self._values, time_us)
        self._ramp = self._wheels.ramp
        self._enabled = self._estop = self._expired = self._limited = False
        self._imu_fault = False
        self._freshness: StaleCommandFilter | None = None
        self._ttl_end: int | None = None
        self._seq: int | None = None
        self._command_us: int | None = None
        self._heard_us = self._loaded_us = time_us
        self._acted: tuple[int, int, int] | None = None
        self._answer = PendingReply()
        self._answer_due: int | None = time_us
        self._stirred = True
        """Something has happened that the next round of the main loop must look at."""
        self._hardware.boot(self._microsteps)
        self._hardware.power(False)
        self._hardware.turn(0, 0)

    @property
    def now_us(self) -> int:
        """Time of the board, which has not wrapped."""
        return self._now

    @property
    def session(self) -> int:
        """The session it is in; 0: none."""
        return self.gate.session

    @property
    def rests(self) -> bool:
        """Whether the robot stands and its drivers have no power."""
        return not (self._enabled or self._wheels.powered or self._ramp.busy)

    @property
    def speeds(self) -> tuple[int, int]:
        """Where the ramp is, urad/s."""
        left, right = self._ramp.speed
        return left, right

    @property
    def powered(self) -> bool:
        """Whether the drivers have power."""
        return self._wheels.powered

    @property
    def counters(self) -> tuple[int, int]:
        """Microsteps issued, as STATE tells them but for the wrap."""
        return self._wheels.counters

    @property
    def status(self) -> StatusFlag:
        """What it says of itself."""
        supply = self._hardware.battery
        bits = (
            (StatusFlag.ENABLED, self._enabled),
            (StatusFlag.MOVING, self._ramp.moving),
            (StatusFlag.ESTOP, self._estop),
            (StatusFlag.TTL_EXPIRED, self._expired),
            (StatusFlag.IMU_FAULT, self._imu_fault),
            (StatusFlag.LOW_BATTERY, 0 < supply < self._values[BATTERY_LOW]),
            (StatusFlag.NO_SESSION, not self.gate.session),
            (StatusFlag.LIMITED, self._limited),
        )
        return StatusFlag(sum(bit for bit, holds in bits if holds))

    # -- time -------------------------------------------------------------------------------------

    def run_to(self, time_us: int) -> None:
        """Let time pass; only rounds of the main loop that have something to do are made."""
        while (due := self._next_round()) <= time_us:
            self._pass(due)
            self._round()
        self._pass(time_us)

    def press(self, pressed: bool) -> None:
        """Press the emergency stop, or let it go."""
        self.button = pressed
        self._stirred = True

    def _pass(self, time_us: int) -> None:
        if time_us > self._now:
            self._hardware.run(time_us - self._now)
            self._now = time_us

    def _next_round(self) -> int:
        after = self._now - (self._now - self._booted) % LOOP_US + LOOP_US
        if self._stirred:
            return after
        times = [self._heard_us + SESSION_TIMEOUT_US] if self.gate.session else []
        times.append(
            self._loaded_us + REFRESH_US if self._answer_due is None else self._answer_due
        )
        if self._ttl_end is not None:
            times.append(self._ttl_end)
        times += self._wheels.due_us()
        if (written_us := self.slot.due_us) is not None:
            times.append(written_us)
        return max(after, min(times) + (self._booted - min(times)) % LOOP_US)

    def _round(self) -> None:
        now = self._now
        self._wheels.catch_up(now - LOOP_US)
        if self.button:
            self._latch()
        if self._ttl_end is not None and now >= self._ttl_end:
            self._ttl_end, self._expired = None, True
            self._counts.add('expired')
            self._ramp.halt()
        if self.gate.session and now - self._heard_us > SESSION_TIMEOUT_US:
            self.gate.end_session()
            self._disable()
        self._wheels.switch_power(self._enabled, now)
        self._stirred = self._wheels.move_on(now)
        self._load()
        self.console.tick()

    def _load(self) -> None:
        if self._answer_due is not None:
            if self._now < self._answer_due:
                return
        elif self._now - self._loaded_us < REFRESH_US:
            return
        else:
            self._answer = PendingReply()
        self._answer_due = None
        self._loaded_us = self._now
        self._load_payload(encode(self._tell(self._answer)))

    # -- packets ----------------------------------------------------------------------------------

    def packet(self, data: bytes) -> None:
        """Take a payload that the radio has received now."""
        self._wheels.catch_up(self._now)
        self._counts.add('received')
        if len(data) > PAYLOAD_LIMIT:
            # The chip never gives more; whatever claims to be wider is not even looked at.
            self._counts.add('short')
            return
        self._stirred = True
        if is_estop_command(data):
            self._latch()
        # Whatever is wrong with a packet, the next one fetches a state that says so.
        self._answer = PendingReply()
        self._answer_due = self._now + self._settle_us
        try:
            frame = decode_downlink(data)
        except FrameError as error:
            strange = error.kind in (FrameErrorKind.VERSION, FrameErrorKind.KIND)
            self._counts.add('bad_version' if strange else 'short')
            return
        if isinstance(frame, Hello):
            self._greet(frame)
        elif isinstance(frame, Poll):
            self._answer = PendingReply(
                (frames.State, frames.Aux, frames.Info)[frame.what], frame.seq
            )
        elif not self._admits(frame):
            self._counts.add('bad_session')
        else:
            self._heard_us = self._now
            self._obey(frame)

    def _admits(self, frame: Command | ParamGet | ParamSet | Action) -> bool:
        session = self.gate.session
        if isinstance(frame, ParamGet):
            return bool(session) and frame.session == session
        # An ESTOP is obeyed already. Of whom nobody knows, nothing else is believed, or a
        # stranger's number would make the host's next ones look old.
        return self.gate.accept(frame) == ''

    def _greet(self, hello: Hello) -> None:
        # Refused or not, INFO tells the host which session holds and whether there is a key.
        self._answer = PendingReply(frames.Info, hello.seq)
        before = self.gate.nonce
        if self.gate.begin_session(hello, self._entropy(NONCE_SIZE)):
            self._counts.add('bad_session')
            return
        if self.gate.key and self.gate.nonce == before:
            return  # the host has not heard the answer
        self._disable()
        self._expired = self._limited = False
        self._seq = self._command_us = self._acted = None
        self._heard_us = self._now
        # HELLO's own delay is the first one known: a burst held back right behind it is found.
        self._freshness = StaleCommandFilter(self._now, hello.host_us)

    def _obey(self, frame: Command | ParamGet | ParamSet | Action) -> None:
        if isinstance(frame, Command):
            self._take(frame)
        elif isinstance(frame, ParamGet):
            known = frame.id < len(BOARD_PARAMETERS)
            rc = frames.OK if known else frames.UNKNOWN
            self._answer = PendingReply(frames.Param, frame.seq, frame.id, rc)
        elif isinstance(frame, ParamSet):
            self._answer = PendingReply(frames.Param, frame.seq, frame.id, self._set(frame))
        else:
            # A host that missed the answer asks again; nothing is done twice.
            if self._acted is None or self._acted[:2] != (frame.seq, frame.verb):
                self._acted = frame.seq, frame.verb, self._act(frame.verb)
            self._answer = PendingReply(frames.Ack, frame.seq, frame.verb, self._acted[2])

    def _take(self, command: Command) -> None:
        if self._seq is not None and not 0 < (command.seq - self._seq) % 256 < 128:
            self._counts.add('duplicates')
            return
        self._seq, self._command_us = command.seq, self._now
        ttl_us = min(10_000 * command.ttl, 1000 * self._values[TTL_MAX])
        late = self._freshness
        if late is not None and late.is_stale(self._now, command.host_us, ttl_us):
            self._counts.add('stale')
            # A wish to stand is never too late; it does not count as a command otherwise.
            moves = (
                command.flags & CommandFlag.ENABLE
                and command.ttl
                and (command.left or command.right)
            )
            if not moves:
                self._ramp.halt()
            return
        self._follow(command, ttl_us)

    def _follow(self, command: Command, ttl_us: int) -> None:
        self._expired = self._limited = False
        if (
            command.flags == CommandFlag.ESTOP_CLEAR
            and not (command.left or command.right)
            and not self.button
        ):
            self._estop = False
        if self._estop or not command.flags & CommandFlag.ENABLE:
            self._disable()
            return
        self._enabled = True
        if not ttl_us:
            self._ttl_end = None
            self._ramp.halt()  # a wish to stop, not an accident
            return
        self._ttl_end = self._now + ttl_us
        limit = min(self._values[MAX_SPEED], self._top_speed)
        self._limited = self._ramp.aim(command.left, command.right, limit)
        self.followed(self._now, command)

    def _disable(self) -> None:
        self._enabled = False
        self._ttl_end = None
        self._ramp.halt()

    def _latch(self) -> None:
        self._estop = True
        self._disable()

    # -- requests ---------------------------------------------------------------------------------

    def _set(self, frame: ParamSet) -> int:
        before = self._wheels.counters
        rc = self._values.set(frame.id, frame.value, self._ramp.busy)
        if frame.id == INVERT_WHEELS:
            self._wheels.counters = before  # they count what was commanded, whatever the pins say
        return rc

    def _act(self, verb: int) -> int:
        if verb == frames.RESET_ODOMETRY:
            if self._ramp.busy:
                return frames.BUSY
            self._wheels.counters = (0, 0)
            return frames.OK
        if verb == frames.CLEAR_COUNTERS:
            self._counts.clear()
            return frames.OK
        return frames.UNKNOWN

    # -- answers ----------------------------------------------------------------------------------

    def _tell(self, answer: PendingReply) -> Uplink:
        session, seq = self.gate.session, answer.seq
        time_us = self._now & 0xFFFFFFFF
        if answer.kind is frames.Info:
            steps = self._values[STEPS_PER_REV], self._microsteps
            return uplink.info_frame(self.gate, seq, self.reset_cause, steps, time_us, self.status)
        if answer.kind is frames.Param:
            return uplink.parameter_frame(session, answer, self._values)
        if answer.kind is frames.Ack:
            return frames.Ack(session, seq, answer.id, answer.rc)
        sample = self._hardware.registers
        self._imu_fault = sample is None
        sample = sample or Registers()
        if answer.kind is frames.Aux:
            battery, counts = self._hardware.battery, self._counts
            return uplink.aux_frame(session, seq, self.status, battery, sample, counts, time_us)
        age_us = None if self._command_us is None else self._now - self._command_us
        seq, ranges = self._seq or 0, self._hardware.ranges
        return uplink.state_frame(
            session, seq, self.status, time_us, self.counters, sample, age_us, ranges
        )
