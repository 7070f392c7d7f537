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
"""Dongle: the C core of its firmware between serial line and radio channel.

All rules of the dongle (docs/radio.md) are in the core; here are its clock and the time that its
processor takes, which the core does not have.
"""

from collections.abc import Callable
import ctypes

from t3mpc_ros.emulator.event_queue import MICROSECOND, EventQueue
from t3mpc_ros.emulator.firmware_library import Board
from t3mpc_ros.emulator.nrf24_radio import RadioChannel, RadioParameters
from t3mpc_ros.radio.protocol.frames import PAYLOAD_LIMIT

SEND_US = 140.0  # delay from the decision to send to the start of the exchange
FINISH_US = 60.0  # delay from the end of an exchange until the firmware has read its outcome
ENCODE_US = 270.0  # delay from there to the first byte of the RESULT
_POWER_ON_RESET = 1
_SERIAL_ROOM = 4096
_WORD = 0xFFFFFFFF
_NEVER = _WORD


class Dongle:
    """The dongle with its firmware.

    ``chip_ok`` returns whether the radio chip responds, ``reply`` receives the bytes of each
    frame for the host.
    """

    def __init__(
        self,
        events: EventQueue,
        channel: RadioChannel,
        chip_ok: Callable[[], bool],
        reply: Callable[[bytes], None],
    ) -> None:
        self._events = events
        self._channel = channel
        self._chip_ok = chip_ok
        self._reply = reply
        self._board = Board('dongle', _POWER_ON_RESET)
        self._serial = ctypes.create_string_buffer(_SERIAL_ROOM)
        self._payload = ctypes.create_string_buffer(PAYLOAD_LIMIT)
        self._boots = self._exchanges = 0
        self.boot(_POWER_ON_RESET)

    def boot(self, reset_cause: int, delay_ns: int = 0) -> None:
        """Reboot; for ``delay_ns`` the boot loader ignores all input."""
        self._boots += 1
        self._exchanges += 1
        self._started_ns = self._events.now_ns + delay_ns
        self._running = False

        def start() -> None:
            self._running = True
            self._board.call('set_chip', self._chip_ok())
            self._board.call('boot', reset_cause)

        if delay_ns:
            self._schedule(delay_ns / MICROSECOND, start)
        else:
            start()

    def feed(self, data: bytes) -> None:
        """Process bytes from the host that arrive now."""
        if self._running:
            self._tick()
            self._board.call('bytes', data, len(data))
            self._act(0.0)

    @property
    def radio(self) -> RadioParameters:
        """Current configuration of the transceiver."""
        numbers = ctypes.create_string_buffer(10)
        self._board.call('radio', numbers)
        channel, rate, power, retry_delay, retries, *address = numbers.raw
        return RadioParameters(channel, rate, power, retry_delay, retries, bytes(address))

    def _schedule(self, delay_us: float, callback: Callable[[], None]) -> None:
        """Schedule a callback that is void after a reset."""
        boots = self._boots
        self._events.schedule_after(delay_us, lambda: callback() if self._boots == boots else None)

    def _tick(self) -> None:
        """Let the main loop come round now."""
        self._board.call('set_chip', self._chip_ok())
        elapsed_ns = self._events.now_ns - self._started_ns
        self._board.call('tick', elapsed_ns // MICROSECOND & _WORD)

    def _act(self, reply_us: float) -> None:
        """Forward what the firmware has written and sent; it has replied so much later."""
        board = self._board
        if size := board.call('take', self._serial, _SERIAL_ROOM):
            data = self._serial.raw[:size]
            if reply_us:
                self._schedule(reply_us, lambda: self._reply(data))
            else:
                self._reply(data)
        if size := board.call('sent', self._payload):
            self._begin_exchange(self._payload.raw[:size])

    def _begin_exchange(self, payload: bytes) -> None:
        self._exchanges += 1
        exchange, radio = self._exchanges, self.radio

        def done(acknowledged: bool, retransmissions: int, reply: bytes) -> None:
            def finish() -> None:
                if self._exchanges == exchange and self._chip_ok():
                    self._tick()
                    self._board.call('answer', acknowledged, retransmissions, reply, len(reply))
                    self._act(ENCODE_US)
                    self._await_tick()

            self._schedule(FINISH_US, finish)

        def begin() -> None:
            if self._chip_ok():
                self._channel.send(payload, radio, done)

        self._schedule(SEND_US, begin)
        self._await_tick()

    def _await_tick(self) -> None:
        """Schedule the end of a gap or of an exchange without outcome."""
        exchange, idle_us = self._exchanges, self._board.call('idle_us')

        def tick() -> None:
            if self._exchanges == exchange:
                self._tick()
                self._act(ENCODE_US)

        if idle_us != _NEVER:
            self._schedule(idle_us, tick)
