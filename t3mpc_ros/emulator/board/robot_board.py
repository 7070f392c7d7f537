# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Robot board firmware: the reaction to each radio payload and to silence (docs/radio.md).

Nothing moves before HELLO and ENABLE. A command is valid for its TTL from reception; on expiry
the wheels ramp down. The newest command replaces the previous one; nothing is queued. An
emergency stop is accepted from any sender. The main loop runs every 200 us, as in the host build
of the firmware core.
"""

from collections.abc import Callable
from typing import NamedTuple

from t3mpc_ros.emulator.board.console import BUILD, FIRMWARE_MAJOR, FIRMWARE_MINOR, Console
from t3mpc_ros.emulator.board.eeprom import KeyStore, SettingsStore, Setup
from t3mpc_ros.emulator.board.hardware import Hardware, Registers
from t3mpc_ros.emulator.board.motion import Wheels
from t3mpc_ros.emulator.board.parameter_store import (
    BATTERY_CUTOFF,
    BATTERY_LOW,
    INVERT_WHEELS,
    MAX_SPEED,
    STEPS_PER_REV,
    TTL_MAX,
    ParameterStore,
)
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.authentication import NONCE_SIZE
from t3mpc_ros.radio.protocol.clock_sync import wrapped_difference
from t3mpc_ros.radio.protocol.codec import decode_downlink, encode, is_estop_command
from t3mpc_ros.radio.protocol.frames import (
    AGE_NONE,
    BOARD_PARAMETERS,
    PAYLOAD_LIMIT,
    VERSION,
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

LOOP_US = 200
"""Period of the main loop."""
SETTLE_US, SETTLE_SLOW_US = 600, 1600
"""Delay from a packet to its reply, until its acknowledgement is sent; second: 250 kbit/s."""
REFRESH_US = 100_000
"""Period at which the loaded reply is renewed without packets."""
SESSION_TIMEOUT_US = 1_800_000_000
"""Silence that ends a session: after a longer one, 32-bit clocks are ambiguous."""
PRESS_US, RELEASE_US = 5_000, 50_000
"""The button counts as pressed, or as released, after this time without a bounce."""
BATTERY_PERIOD_US = 100_000
"""Period of the battery measurement, whose low pass has a time constant of 8 periods."""
_BATTERY_WEIGHT = 8
MAX_STEP_RATE = 10_000
"""Maximum microsteps per second of a wheel: one per two ticks of a 20 kHz interrupt."""
_REVOLUTION = 6_283_185.3071795865
"""urad"""
_CLOCK_RANGE = 1 << 32
"""us"""


class RobotBoard:
    """Firmware of the robot board.

    Parameters
    ----------
    hardware
        Motors, sensors and battery.
    key
        16 bytes; empty for an open link.
    entropy
        Returns a number of unpredictable bytes, for nonces.
    load
        Loads the payload that the next packet fetches.
    settle_us
        Delay from a packet to its reply.
    setup
        Stored settings; None: a board that was never set up.
    """

    def __init__(
        self,
        hardware: Hardware,
        key: bytes,
        entropy: Callable[[int], bytes],
        load: Callable[[bytes], None],
        settle_us: int = SETTLE_US,
        setup: Setup | None = Setup(),  # noqa: B008 (immutable)
    ) -> None:
        self._hardware = hardware
        self.key_store = KeyStore(key)
        self.settings_store = SettingsStore(setup)
        self.on_setup: Callable[[Setup], None] = lambda setup: None
        """Called with the settings in effect, at boot and after a change."""
        self._entropy = entropy
        self._load_payload = load
        self._settle_us = settle_us
        self._parameters = ParameterStore()
        self.button_pressed = False
        """Level of the emergency stop button, before it is debounced."""
        self.on_command: Callable[[int, Command], None] = lambda now_us, command: None
        """Called with time and content of each command that sets the wheel speeds."""
        self.console = Console(self)
        self._now = 0
        self.boot(1)

    def boot(self, reset_cause: int, time_us: int = 0) -> None:
        """Boot: at rest, drivers off, no session; the RAM is cleared."""
        self.key_store.lose_power(self._now)
        self.settings_store.lose_power(self._now)
        self._now = self._booted = time_us
        self.reset_cause = reset_cause
        """Reset flags as in the MCUSR register of an AVR."""
        self.verifier = self.key_store.create_verifier()
        self.console.reset()
        self._parameters.reset()
        self.settings_store.boot(time_us)
        self._use_microsteps()
        self._pressed = False
        self._button_us = self._battery_us = time_us
        self._battery_sum = 0
        self._flat = False
        self._measure_battery()
        self._counters = PacketCounters()
        self._wheels = Wheels(self._hardware, self._parameters, time_us)
        self._ramp = self._wheels.ramp
        self._enabled = self._estop = self._expired = self._limited = False
        self._imu_fault = False
        self._stale_filter: StaleCommandFilter | None = None
        self._ttl_end: int | None = None
        self._seq: int | None = None
        self._command_us: int | None = None
        self._received_us = self._loaded_us = time_us
        self._last_action: tuple[int, int, int] | None = None
        """seq, verb and result code."""
        self._reply = PendingReply()
        self._reply_due: int | None = time_us
        self._pass_needed = True
        """Whether the next pass of the main loop has work to do."""
        self._hardware.boot(self._microsteps)
        self._hardware.set_power(False)
        self._hardware.set_speeds(0, 0)
        self.on_setup(self.settings_store.setup)

    def apply_settings(self) -> None:
        """Apply settings that were written at rest; the counters continue."""
        counters = self._wheels.counters
        self._use_microsteps()
        self._hardware.boot(self._microsteps)
        self._wheels.counters = counters
        self.on_setup(self.settings_store.setup)

    def _use_microsteps(self) -> None:
        self._microsteps = self.settings_store.setup.microsteps
        self._parameters.use_microsteps(self._microsteps)
        steps = self._parameters[STEPS_PER_REV] * self._microsteps
        self._max_speed = int(MAX_STEP_RATE * _REVOLUTION / steps / 1000)

    @property
    def now_us(self) -> int:
        """Time since boot, without the wrap to 32 bits."""
        return self._now

    @property
    def session(self) -> int:
        """Number of the session; 0: none."""
        return self.verifier.session

    @property
    def at_rest(self) -> bool:
        """Whether the robot is disabled and stopped, and its drivers are off."""
        return not (self._enabled or self._wheels.powered or self._ramp.busy)

    @property
    def eeprom_done_us(self) -> int | None:
        """Time at which the EEPROM writes are complete; None: no write in progress."""
        times = (self.key_store.done_us, self.settings_store.done_us)
        return max((time for time in times if time is not None), default=None)

    @property
    def speeds(self) -> tuple[int, int]:
        """Current speeds of the ramp, urad/s."""
        left, right = self._ramp.speed
        return left, right

    @property
    def powered(self) -> bool:
        """Whether the motor drivers have power."""
        return self._wheels.powered

    @property
    def counters(self) -> tuple[int, int]:
        """Microsteps issued, as in STATE but without the wrap to 32 bits."""
        return self._wheels.counters

    @property
    def packet_counters(self) -> 'PacketCounters':
        """Counters of received and rejected packets."""
        return self._counters

    @property
    def status(self) -> StatusFlag:
        """Status flags of the uplink frames."""
        supply = self._battery
        bits = (
            (StatusFlag.ENABLED, self._enabled),
            (StatusFlag.MOVING, self._ramp.moving),
            (StatusFlag.ESTOP, self._estop),
            (StatusFlag.TTL_EXPIRED, self._expired),
            (StatusFlag.IMU_FAULT, self._imu_fault),
            (StatusFlag.LOW_BATTERY, 0 < supply < self._parameters[BATTERY_LOW]),
            (StatusFlag.NO_SESSION, not self.verifier.session),
            (StatusFlag.LIMITED, self._limited),
        )
        return StatusFlag(sum(bit for bit, holds in bits if holds))

    # -- time -------------------------------------------------------------------------------------

    def run_to(self, time_us: int) -> None:
        """Advance to a time; passes of the main loop without work are skipped."""
        while (due := self._next_pass()) <= time_us:
            self._advance(due)
            self._pass()
        self._advance(time_us)

    def press_button(self, pressed: bool) -> None:
        """Press or release the emergency stop button."""
        if self.button_pressed == self._pressed:
            # The last pass saw no difference.
            self._button_us = self._now - (self._now - self._booted) % LOOP_US
        self.button_pressed = pressed
        self._pass_needed = True

    def _advance(self, time_us: int) -> None:
        if time_us > self._now:
            self._hardware.run(time_us - self._now)
            self._now = time_us

    def _next_pass(self) -> int:
        after = self._now - (self._now - self._booted) % LOOP_US + LOOP_US
        if self._pass_needed:
            return after
        times = [self._received_us + SESSION_TIMEOUT_US] if self.verifier.session else []
        times.append(self._loaded_us + REFRESH_US if self._reply_due is None else self._reply_due)
        if self._ttl_end is not None:
            times.append(self._ttl_end)
        times += self._wheels.due_times()
        times.append(self._battery_us + BATTERY_PERIOD_US)
        if self.button_pressed != self._pressed:
            times.append(self._button_us + (PRESS_US if self.button_pressed else RELEASE_US))
        if (done_us := self.eeprom_done_us) is not None:
            times.append(done_us)
        return max(after, min(times) + (self._booted - min(times)) % LOOP_US)

    def _pass(self) -> None:
        """Run one pass of the main loop."""
        now = self._now
        self._wheels.skip_periods(now - LOOP_US)
        self._watch_button()
        self._watch_battery()
        if self._ttl_end is not None and now >= self._ttl_end:
            self._ttl_end, self._expired = None, True
            self._counters.increment('expired')
            self._ramp.stop()
        if self.verifier.session and now - self._received_us > SESSION_TIMEOUT_US:
            self.verifier.end_session()
            self._disable()
        self._wheels.update_power(self._enabled, now)
        self._load_reply()
        self._pass_needed = self._wheels.update_ramp(now, self._estop)
        self.console.update()

    def _watch_button(self) -> None:
        now, delay = self._now, PRESS_US if self.button_pressed else RELEASE_US
        if self.button_pressed == self._pressed:
            self._button_us = now
        elif now - self._button_us >= delay:
            self._pressed = self.button_pressed
        if self._pressed:
            self._latch_estop()

    @property
    def _battery(self) -> int:
        """Filtered voltage of the battery, mV; 0: not measured."""
        return self._battery_sum // _BATTERY_WEIGHT

    def _watch_battery(self) -> None:
        if self._now - self._battery_us < BATTERY_PERIOD_US:
            return
        self._battery_us = self._now
        self._measure_battery()
        if self._flat:
            self._disable()

    def _measure_battery(self) -> None:
        supply = self._hardware.battery
        if not supply or not self._battery_sum:
            self._battery_sum = _BATTERY_WEIGHT * supply
        else:
            self._battery_sum += supply - self._battery
        cutoff, low = self._parameters[BATTERY_CUTOFF], self._parameters[BATTERY_LOW]
        # The voltage rises as soon as the motors rest: below the warning, the robot stays off.
        if not self._battery or self._battery >= max(cutoff, low):
            self._flat = False
        elif self._battery < cutoff:
            self._flat = True

    def _load_reply(self) -> None:
        if self._reply_due is not None:
            if self._now < self._reply_due:
                return
        elif self._now - self._loaded_us < REFRESH_US:
            return
        else:
            self._reply = PendingReply()
        self._reply_due = None
        self._loaded_us = self._now
        self._load_payload(encode(self._reply_frame(self._reply)))

    # -- packets ----------------------------------------------------------------------------------

    def receive(self, data: bytes) -> None:
        """Process a payload that the radio receives now."""
        self._wheels.skip_periods(self._now)
        self._counters.increment('received')
        if len(data) > PAYLOAD_LIMIT:
            # The chip never delivers more: a larger width is a defect, the content is ignored.
            self._counters.increment('short')
            return
        self._pass_needed = True
        if is_estop_command(data):
            self._latch_estop()
        # The reply to an invalid packet is STATE.
        self._reply = PendingReply()
        self._reply_due = self._now + self._settle_us
        try:
            frame = decode_downlink(data)
        except FrameError as error:
            unknown = error.kind in (FrameErrorKind.VERSION, FrameErrorKind.KIND)
            self._counters.increment('bad_version' if unknown else 'short')
            return
        if isinstance(frame, Hello):
            self._process_hello(frame)
        elif isinstance(frame, Poll):
            kind = (frames.State, frames.Aux, frames.Info)[frame.what]
            self._reply = PendingReply(kind, frame.seq)
        elif not self._is_accepted(frame):
            self._counters.increment('bad_session')
        else:
            self._received_us = self._now
            self._process(frame)

    def _is_accepted(self, frame: Command | ParamGet | ParamSet | Action) -> bool:
        session = self.verifier.session
        if isinstance(frame, ParamGet):
            return bool(session) and frame.session == session
        # An ESTOP of an unknown sender is already latched. Its sequence number is ignored: it
        # would make the next commands of the host look old.
        return self.verifier.accept(frame) == ''

    def _process_hello(self, hello: Hello) -> None:
        # Even after a rejection, INFO reports the current session, the state of the settings, and
        # whether a key is stored.
        self._reply = PendingReply(frames.Info, hello.seq)
        if self.settings_store.state not in (frames.SETTINGS_GOOD, frames.SETTINGS_ONE_COPY):
            # Its address is that of every such board, and its microsteps are unknown.
            self._counters.increment('bad_session')
            return
        before = self.verifier.nonce
        if self.verifier.begin_session(hello, self._entropy(NONCE_SIZE)):
            self._counters.increment('bad_session')
            return
        if self.verifier.key and self.verifier.nonce == before:
            return  # a repetition: the host has not received the reply
        self._disable()
        self._expired = self._limited = False
        self._seq = self._command_us = self._last_action = None
        self._received_us = self._now
        # The delay of HELLO is the first reference: a burst held back after it is detected.
        self._stale_filter = StaleCommandFilter(self._now, hello.host_us)

    def _process(self, frame: Command | ParamGet | ParamSet | Action) -> None:
        if isinstance(frame, Command):
            self._process_command(frame)
        elif isinstance(frame, ParamGet):
            known = frame.id < len(BOARD_PARAMETERS)
            rc = frames.OK if known else frames.UNKNOWN
            self._reply = PendingReply(frames.Param, frame.seq, frame.id, rc)
        elif isinstance(frame, ParamSet):
            self._reply = PendingReply(frames.Param, frame.seq, frame.id, self._write(frame))
        else:
            # A host that missed the reply repeats the request; the action runs only once.
            if self._last_action is None or self._last_action[:2] != (frame.seq, frame.verb):
                self._last_action = frame.seq, frame.verb, self._execute(frame.verb)
            self._reply = PendingReply(frames.Ack, frame.seq, frame.verb, self._last_action[2])

    def _process_command(self, command: Command) -> None:
        if self._seq is not None and not 0 < (command.seq - self._seq) % 256 < 128:
            self._counters.increment('duplicates')
            return
        self._seq, self._command_us = command.seq, self._now
        ttl_us = min(10_000 * command.ttl, 1000 * self._parameters[TTL_MAX])
        stale_filter = self._stale_filter
        if stale_filter is not None and stale_filter.is_stale(self._now, command.host_us, ttl_us):
            self._counters.increment('stale')
            # A stale command to stop still stops the wheels; it has no other effect.
            moves = (
                command.flags & CommandFlag.ENABLE
                and command.ttl
                and (command.left or command.right)
            )
            if not moves:
                self._ramp.stop()
            return
        self._apply(command, ttl_us)

    def _apply(self, command: Command, ttl_us: int) -> None:
        self._expired = self._limited = False
        if (
            command.flags == CommandFlag.ESTOP_CLEAR
            and not (command.left or command.right)
            and not (self._pressed or self.button_pressed)
        ):
            self._estop = False
        if self._estop or self._flat or not command.flags & CommandFlag.ENABLE:
            self._disable()
            return
        self._enabled = True
        if not ttl_us:
            self._ttl_end = None
            self._ramp.stop()  # commanded, not expired
            return
        self._ttl_end = self._now + ttl_us
        limit = min(self._parameters[MAX_SPEED], self._max_speed)
        self._limited = self._ramp.set_target(command.left, command.right, limit)
        self.on_command(self._now, command)

    def _disable(self) -> None:
        self._enabled = False
        self._ttl_end = None
        self._ramp.stop()

    def _latch_estop(self) -> None:
        self._estop = True
        self._disable()

    # -- requests ---------------------------------------------------------------------------------

    def _write(self, frame: ParamSet) -> int:
        before = self._wheels.counters
        rc = self._parameters.set(frame.id, frame.value, self._ramp.busy)
        if frame.id == INVERT_WHEELS:
            self._wheels.counters = before  # counted in the direction of the command
        return rc

    def _execute(self, verb: int) -> int:
        if verb == frames.RESET_ODOMETRY:
            if self._ramp.busy:
                return frames.BUSY
            self._wheels.counters = (0, 0)
            return frames.OK
        if verb == frames.CLEAR_COUNTERS:
            self._counters.clear()
            return frames.OK
        return frames.UNKNOWN

    # -- replies ----------------------------------------------------------------------------------

    def _reply_frame(self, reply: 'PendingReply') -> Uplink:
        """Return the uplink frame with the values of this instant."""
        session, seq = self.verifier.session, reply.seq
        time_us = self._now & 0xFFFFFFFF
        if reply.kind is frames.Info:
            return self._info(seq)
        if reply.kind is frames.Param:
            return self._parameter(reply)
        if reply.kind is frames.Ack:
            return frames.Ack(session, seq, reply.id, reply.rc)
        sample = self._hardware.registers
        self._imu_fault = sample is None
        sample = sample or Registers()
        if reply.kind is frames.Aux:
            return self._aux(seq, time_us, sample)
        return self._state(time_us, sample)

    def _info(self, seq: int) -> frames.Info:
        store = self.settings_store
        return frames.Info(
            self.verifier.session,
            seq,
            VERSION,
            FIRMWARE_MAJOR,
            FIRMWARE_MINOR,
            self.reset_cause,
            len(BOARD_PARAMETERS),
            self._parameters[STEPS_PER_REV],
            self._microsteps,
            self.status,
            store.state,
            store.setup.channel,
            store.setup.address,
            BUILD,
            self.verifier.nonce,
        )

    def _parameter(self, reply: 'PendingReply') -> frames.Param:
        """Return the PARAM of a request; value and bounds of an unknown parameter are zero."""
        head = self.verifier.session, reply.seq, reply.id, reply.rc
        if reply.id >= len(BOARD_PARAMETERS):
            return frames.Param(*head, 0, 0, 0)
        parameter = BOARD_PARAMETERS[reply.id]
        return frames.Param(*head, self._parameters[reply.id], parameter.low, parameter.high)

    def _aux(self, seq: int, time_us: int, sample: Registers) -> frames.Aux:
        counters = self._counters
        return frames.Aux(
            self.verifier.session,
            seq,
            self.status,
            self._battery,
            sample.temperature,
            sample.accel_z,
            sample.gyro_x,
            sample.gyro_y,
            counters['received'],
            counters['duplicates'],
            counters['bad_session'],
            counters['stale'],
            counters['expired'],
            time_us,
            counters['bad_version'],
            counters['short'],
        )

    def _state(self, time_us: int, sample: Registers) -> frames.State:
        age = AGE_NONE
        if self._command_us is not None:
            age = min((self._now - self._command_us) // 10, AGE_NONE)
        left, right = map(_wrap_int32, self.counters)
        return frames.State(
            self.verifier.session,
            self._seq or 0,
            self.status,
            time_us,
            left,
            right,
            sample.gyro_z,
            sample.accel_x,
            sample.accel_y,
            age,
            self._hardware.ranges,
        )


class PendingReply(NamedTuple):
    """Kind of the frame to load next, and the request it replies to."""

    kind: type[Uplink] = frames.State
    seq: int = 0
    id: int = 0
    rc: int = 0


class PacketCounters:
    """Counters of AUX, modulo 2**16, by field name."""

    _NAMES = (
        'received',
        'duplicates',
        'bad_session',
        'stale',
        'expired',
        'bad_version',
        'short',
    )

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Reset all counters to zero."""
        self._counts = dict.fromkeys(self._NAMES, 0)

    def __getitem__(self, name: str) -> int:
        return self._counts[name]

    def increment(self, name: str) -> None:
        """Increment a counter."""
        self._counts[name] = self._counts[name] + 1 & 0xFFFF


class StaleCommandFilter:
    """Detects commands held up on their way, from the clock of the robot and the host's stamps.

    The reference is the smallest delay of the last 5 to 10 s; a command is stale if its delay
    exceeds the reference by more than TTL and slack. Windows change only on reception: after a
    silence, commands held during all of it are still compared with the reference before it.

    Parameters
    ----------
    received_us, host_us
        Time of reception and stamp of the HELLO.
    """

    WINDOW_US = 5_000_000
    SLACK_US = 50_000
    """Drift of two clocks that differ by 0.5 % within two windows."""

    def __init__(self, received_us: int, host_us: int) -> None:
        self._window_start = self._previous_start = received_us
        self._minimum = self._previous_minimum = (received_us - host_us) % _CLOCK_RANGE

    def is_stale(self, received_us: int, host_us: int, ttl_us: int) -> bool:
        """Return whether a command is stale, and update the reference."""
        delay = (received_us - host_us) % _CLOCK_RANGE
        if received_us - self._window_start >= self.WINDOW_US:
            self._previous_start, self._previous_minimum = self._window_start, self._minimum
            self._window_start, self._minimum = received_us, delay
        elif wrapped_difference(delay, self._minimum) > 0:
            self._minimum = delay
        reference = self._previous_minimum
        if wrapped_difference(self._minimum, reference) > 0:
            reference = self._minimum
        # During a silence the clocks drift further, by 0.5 % of its duration as in the slack.
        silence = max(received_us - self._previous_start - 2 * self.WINDOW_US, 0)
        return wrapped_difference(reference, delay) > ttl_us + self.SLACK_US + silence // 200


def _wrap_int32(counter: int) -> int:
    """Return a counter wrapped to 32 bits, signed."""
    return (counter + (1 << 31)) % (1 << 32) - (1 << 31)
