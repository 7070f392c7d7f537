# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Texts that explain why the robot does not move, with a remedy where one is known."""

from t3mpc_ros.radio.protocol import frames

NO_COMMAND = 'no command yet'
DONGLE_STARTING = 'the dongle does not answer yet: it takes 1.5 s to start'
DONGLE_TIMEOUT = 'the dongle stopped answering: did it restart?'
NO_DONGLE = 'no dongle answers on this port: is it the right port?'
NO_CHIP = 'the radio chip of the dongle does not answer: check its wiring and supply'
ROBOT_USB = (
    'this is the USB port of the robot board, not of the dongle; '
    'ls -l /dev/serial/by-id lists both'
)
RADIO_NOT_CONFIGURED = 'the dongle rejects the radio configuration'
HOST_KEY_MISSING = 'the robot requires signed commands: give the host the key'
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
DRIVES_DISABLED = 'the drives of the robot are not enabled yet'
COMMAND_EXPIRED = 'the last command has expired'
TTL_EXPIRED = 'no command reached the robot in time: it stopped by itself'
ROBOT_ESTOP = 'the emergency stop of the robot is latched'
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


def refused(what: str, reason: int) -> str:
    """Return the text for frames that the robot refuses, with the reason in INFO or AUX."""
    return f'the robot refuses {what}: {_REFUSALS.get(reason, "no reason given")}'


def robot_version(version: int) -> str:
    """Return the text for a robot of another version of the protocol."""
    return (
        f'the robot must speak protocol {frames.VERSION}: it speaks {version}; flash both boards'
    )


def robot_absent(channel: int) -> str:
    """Return the text for a robot that does not answer on a radio channel."""
    return f'the robot does not answer: is it on, in range, on channel {channel}?'
