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
"""Texts that explain why the robot does not move, with a remedy where one is known."""

from t3mpc_ros.radio.protocol import frames

NO_COMMAND = 'no command yet'
DONGLE_STARTING = 'the dongle does not answer yet: it takes 1.5 s to start'
DONGLE_TIMEOUT = 'the dongle stopped answering: did it restart, is its cable good?'
BOARD_TIMEOUT = 'the robot board stopped answering: did it restart, is its cable good?'
ROBOT_SILENT = 'the robot board does not answer'
ANSWERS_AGAIN = 'no command since the robot answers again'
NO_DONGLE = 'no dongle answers on this port: is it the right port?'
NO_REPLY = 'the dongle does not reply: is its cable loose or damaged?'
NO_CHIP = 'the radio chip of the dongle does not answer: check its wiring and supply'
ROBOT_USB = (
    'this is the USB port of the robot board, not of the dongle; '
    'ls -l /dev/serial/by-id lists both'
)
"""Where a dongle is needed, or the firmware of the robot is older than 2.1."""
RADIO_NOT_CONFIGURED = 'the dongle rejects the radio configuration'
HOST_KEY_MISSING = (
    'the robot requires signed commands: give the host the key, by key_file of radio_bridge or '
    '--key of t3mpc robot'
)
ROBOT_KEY_MISSING = (
    'the robot has no key to verify signatures: store the key in it, or use none on the host'
)
SETTINGS = {
    frames.SETTINGS_MISSING: (
        'the robot has no settings, so it accepts no session: t3mpc robot setup, over its own USB'
    ),
    frames.SETTINGS_DAMAGED: (
        'the settings of the robot are damaged, so it accepts no session: t3mpc robot setup, over '
        'its own USB'
    ),
    frames.SETTINGS_OLD: (
        'the settings of the robot are of an older firmware, so it accepts no session: t3mpc '
        'robot setup, over its own USB'
    ),
    frames.CALIBRATION_DAMAGED: (
        'the calibration of the robot is damaged, so it accepts no session: write it again, over '
        'its own USB'
    ),
}
"""By the state of the settings in INFO."""
BATTERY_CUTOFF = 'the battery of the robot is below its cut-off: charge it'
BATTERY_ABSENT = (
    'the robot measures no battery voltage, but its settings say that the battery is wired: check '
    'wire and divider'
)
DRIVES_DISABLED = 'the drives of the robot are not enabled yet'
COMMAND_EXPIRED = 'the last command has expired'
TTL_EXPIRED = 'no command reached the robot in time: it stopped by itself'
SESSION_LOST = 'the robot has lost its session'
OTHER_ROBOT = 'another robot answers'
ROBOT_ESTOP = (
    'the emergency stop of the robot is latched: release its button, then call e_stop of '
    'radio_bridge with false'
)
ESTOP_BUTTON_HELD = 'the emergency stop of the robot stays latched: is its button still pressed?'
SHUT_DOWN = 'the link is shut down'

_REFUSALS: dict[int, str] = {
    frames.RefusalReason.VERSION: 'another version of the protocol; flash both boards',
    frames.RefusalReason.FORM: 'malformed',
    frames.RefusalReason.SETTINGS: 'it has no valid settings or calibration; t3mpc robot setup',
    frames.RefusalReason.KEY: 'its key is damaged; t3mpc robot key write, over its own USB',
    frames.RefusalReason.UNSIGNED: 'not signed; give the host the key',
    frames.RefusalReason.SIGNED: 'signed, but it has no key; t3mpc robot key write',
    frames.RefusalReason.SESSION: 'another session; does a second host command it?',
    frames.RefusalReason.TAG: 'bad tag, so the keys differ (t3mpc robot key state)',
    frames.RefusalReason.SEQUENCE: 'repeated, or overtaken by newer ones',
    frames.RefusalReason.STALE: 'they arrive too late, or its answers do',
}

_RESET_CAUSES = ('power on', 'reset button or opened port', 'brown-out', 'watchdog', 'JTAG')
"""By bit of the register MCUSR of the AVR."""


def reset_cause(register: int) -> str:
    """Return the cause of a reset in INFO or in the log of the robot."""
    causes = [text for bit, text in enumerate(_RESET_CAUSES) if register >> bit & 1]
    return ', '.join(causes) or 'started by a boot loader'


def restarted(register: int, unknown: float) -> str:
    """Return the text for a robot that restarted, with the length (m) of its unknown path."""
    if not unknown:
        return f'the robot restarted ({reset_cause(register)})'
    return (
        f'the robot restarted in motion ({reset_cause(register)}): up to {unknown:.2f} m of its '
        'path are unknown'
    )


_LOSS_TEXTS = {
    'radio': (
        'on the radio: distance, antenna, supply of a radio module, or another transmitter on the '
        'channel; t3mpc robot scan'
    ),
    'robot': 'at the robot: it acknowledges, but is too slow with its state; t3mpc robot log',
}


def lost_cycles(hop: str, host_errors: int, dongle_errors: int) -> str:
    """Return where cycles are lost: ``hop`` of the reply, and damaged frames at both ends."""
    if hop in _LOSS_TEXTS:
        return _LOSS_TEXTS[hop]
    if host_errors or dongle_errors:
        return (
            f'on the cable: {host_errors} damaged frames at the host, {dongle_errors} at the '
            'dongle; another cable or port'
        )
    return 'at the dongle: no reply within 50 ms, and no damaged frame'


def refused(what: str, reason: int) -> str:
    """Return the text for frames that the robot refuses, with the reason in INFO or AUX."""
    return f'the robot refuses {what}: {_REFUSALS.get(reason, "no reason given")}'


def robot_version(version: int) -> str:
    """Return the text for a robot of another version of the protocol."""
    return (
        f'the robot must speak protocol {frames.VERSION}: it speaks {version}; flash both boards'
    )


def two_robots(address: str, channel: int) -> str:
    """Return the text for two robots with one address."""
    return (
        f'two robots answer on address {address}, channel {channel}: give each an address of its '
        'own, t3mpc robot setup --address'
    )


def host_suspended(seconds: float) -> str:
    """Return the text for a host that was not executed for a time."""
    return f'this program was not executed for {seconds:.1f} s: was it suspended?'


def robot_absent(address: str, channel: int) -> str:
    """Return the text for a robot that does not answer by radio."""
    return (
        f'the robot does not answer: is it on, in range, on channel {channel}, at address '
        f'{address}?'
    )
