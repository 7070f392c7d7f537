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
"""Firmware core: what a boot, a new session, settings or a release leave of what was before.

The memory of a used board is compared with that of a new one, field by field: what a test of
frames does not ask for is compared as well.
"""

from collections.abc import Iterator
import ctypes
import os
import random
import re
import struct
import subprocess

import pytest
from support import firmware_core as core
from support.missing_tools import find, needs

from t3mpc_ros.radio.protocol.codec import encode
from t3mpc_ros.radio.protocol.frames import CALIBRATION_RECORD, SETTINGS_RECORD, Key
from t3mpc_ros.radio.tool import eeprom_records, robot_settings
from t3mpc_ros.radio.tool.robot_settings import RobotSettings
from t3mpc_ros.robot.calibration import Calibration, DividerCorrection, SharpCurve

HEADERS = '\n'.join(path.read_text() for path in sorted((core.FIRMWARE / 'core').glob('*.h')))
STRUCTS = dict(re.findall(r'^struct (t3_\w+) \{\n(.*?)^\};', HEADERS, re.DOTALL | re.MULTILINE))
POINTERS = ('robot.port', 'console.port', 'console.robot', 'dongle.port')


def members(kind: str, prefix: str) -> Iterator[str]:
    """Yield the members of a structure of the core, those of structures in it included."""
    text = re.sub(r'//.*', '', STRUCTS[kind])
    for declaration in re.sub(r'enum \{[^}]*\}', 'enum', text).split(';'):
        words = re.findall(r'\w+', re.sub(r'\[[^\]]*\]', '', declaration).replace('const', ''))
        structure = words[:1] == ['struct']
        typed = structure or (words[:1] == ['enum'] and len(words) > 2)
        for name in words[1 + typed :]:
            if structure and words[1] in STRUCTS and not {*'*['} & {*declaration}:
                yield from members(words[1], f'{prefix}.{name}')
            else:
                yield f'{prefix}.{name}'


@pytest.fixture(scope='module')
def layout(library, tmp_path_factory):
    """Return offset and size of each member of what ctypes holds: by robot and by dongle."""
    folder = tmp_path_factory.mktemp('layout')
    found = {}
    needs('C compiler')
    compiler = find('C compiler')
    for board, parts in (('robot', ('robot', 'console')), ('dongle', ('dongle',))):
        paths = [path for part in parts for path in members(f't3_{part}', part)]
        host = f't3_host_{board}'
        rows = ''.join(
            f'{{offsetof(struct {host}, {p}), sizeof(((struct {host} *)0)->{p})}},' for p in paths
        )
        source = folder / f'{board}.c'
        source.write_text(
            f'#include <stddef.h>\n#include "{core.FIRMWARE}/host/t3_host_{board}.c"\n'
            f'const size_t layout[][2] = {{{rows}}};\n'
        )
        folders = [f'-I{core.FIRMWARE}/{part}' for part in ('core', 'host')]
        command = [compiler, '-shared', '-fPIC', *folders, '-o', source.with_suffix('.so'), source]
        subprocess.run(command, check=True)
        made = ctypes.CDLL(str(source.with_suffix('.so')), mode=os.RTLD_LAZY)
        table = (ctypes.c_size_t * 2 * len(paths)).in_dll(made, 'layout')
        found[board] = {path: tuple(row) for path, row in zip(paths, table, strict=True)}
    assert len(found['robot']) > 90
    assert len(found['dongle']) > 20
    return found


def memory(part, layout):
    """Return the bytes of each member, without the pointers."""
    return {
        path: ctypes.string_at(part._object.value + offset, size)
        for path, (offset, size) in layout[part.kind].items()
        if path not in POINTERS
    }


def unlike(one, other, layout, kept=()):
    """Return the members that differ, but for those that begin with a name that is kept."""
    first, second = memory(one, layout), memory(other, layout)
    return [p for p in first if first[p] != second[p] and not p.startswith(kept)]


def like(robot, library, key=b''):
    """Return a board with the memory cells and the hardware of another one, not booted again."""
    made = core.Robot(library, key)
    for address in range(1024):
        made.call('poke_eeprom', address, robot.call('cell', address))
    return made


def use(robot, r):
    """Do everything that a host, a hand and time can do, in any order; return the replies."""
    flags = core.ESTOP, core.CLEAR, 0, core.ENABLE

    def set_parameter():
        body = struct.pack('<BBBBi', 0x23, 0x5A, 9, r.randrange(12), r.randrange(40_000))
        return robot.request(robot.sign(body))

    actions = (
        lambda: robot.hello(nonce=r.randbytes(8)),
        lambda: robot.act(r.randrange(4), r.randrange(4)),
        set_parameter,
        lambda: robot.send(robot.command(0, 0, flags=r.choice(flags))),
        lambda: robot.call('press', r.random() < 0.3),
        lambda: robot.run(r.choice((2000, 7000, 60_000))),
        lambda: robot.call('set_adc', r.randrange(9), r.randrange(1024)),
        lambda: robot.send(r.randbytes(r.randrange(1, 33))),
        lambda: robot.console(r.choice((b'\x03\x01ping', b'\x06\x09\0\0', b'\x05\x09'))),
        lambda: robot.send(robot.command(3000, 1000, host_us=robot.host_us + (1 << 31))),
        lambda: robot.call('set_imu', r.random() < 0.5, (ctypes.c_int16 * 7)(*range(7))),
        *6 * (lambda: robot.send(robot.command(r.randrange(-9000, 9000), 5000, ttl=20)),),
    )
    replies = []
    for _ in range(40):
        replies.append(r.choice(actions)())
        robot.run(r.choice((300, 5000, 150_000)))
        replies.append((robot.reply(), robot.status, robot.speeds, robot.call('levels')))
    return replies


def come_to_rest(robot):
    """Release what is pressed, measure nothing, and wait until nothing changes any more."""
    robot.call('press', False)
    for channel in range(9):
        robot.call('set_adc', channel, 0xFFFF)
    robot.call('set_imu', True, (ctypes.c_int16 * 7)())
    robot.run(2_000_000)


@pytest.mark.parametrize('key', [b'', core.KEY], ids=['open', 'keyed'])
@pytest.mark.parametrize('seed', range(2))
def test_a_booted_robot_is_as_new(library, layout, key, seed):
    used = core.Robot(library, key)
    use(used, random.Random(seed))
    come_to_rest(used)
    new = like(used, library, key)
    for each in (used, new):
        come_to_rest(new)
        each.run(-each.now % 200)  # to the same phase of the main loop
        each.call('usb_take', ctypes.create_string_buffer(4096), 4096)
        each.call('boot', 4, 77)
        each.seq, each.session_key, each.delay, each.echo_age = 0, b'', 1000, 1000
    assert not unlike(used, new, layout)
    assert use(used, random.Random(seed)) == use(new, random.Random(seed))


CLEARED = (*(f'counters.{name}' for name in core.COUNTERS), 'refusal', 'refused')
"""What CLEAR_COUNTERS clears."""
TIMES = (
    'robot.rest_us', 'robot.button_us', 'robot.battery_us', 'robot.loaded_us', 'robot.period_us',
    'robot.tick_us', 'robot.last_frame_us', 'robot.answer_from_us', 'robot.longest_us',
    'robot.ttl_from_us', 'robot.ttl_us', 'robot.command_us', 'robot.steps.time_us',
    'robot.next_range', 'console',
)  # fmt: skip
"""Instants of what has happened, and the log."""
KEPT_IN_A_SESSION = (
    'robot.counters', 'robot.refused', 'robot.parameters', 'robot.steps.wheels', 'robot.estop',
    'robot.action_seq', 'robot.action_verb', 'robot.action_rc', 'robot.session.greetings',
    'robot.session.robot_nonce', 'robot.session.session_key', 'robot.session.last_us',
)  # fmt: skip
"""What a host that comes later must see, and nonces, no two of which are alike."""


@pytest.mark.parametrize('key', [b'', core.KEY], ids=['open', 'keyed'])
@pytest.mark.parametrize('seed', range(2))
def test_a_new_session_begins_as_the_first_one(library, layout, key, seed):
    """An action of the session before, of the same number, is no repetition."""
    used, new = core.Robot(library, key), core.Robot(library, key)
    used.run(1000)
    used.hello()
    if key:  # the clock of the host wraps within the session
        used.send(used.command(3000, 3000, host_us=0xFFFFFFF0))
        used.send(used.command(3000, 3000, host_us=5, epoch=1))
    use(used, random.Random(seed))
    come_to_rest(used)
    used.hello()
    used.send(used.command(0, 0, flags=core.CLEAR))
    used.send(b'\xff')
    used.run(1000)
    used.act(2, 1)
    assert not any(b''.join(memory(used, layout)[f'robot.{name}'] for name in CLEARED))
    used.drive(30_000, 9000, 200_000)  # scaled down, and then it expires
    for each in (used, new):
        come_to_rest(each)
        each.seq = 0
        each.hello(session=0x33, nonce=bytes(range(8)))
    assert not unlike(used, new, layout, TIMES + KEPT_IN_A_SESSION)
    used.call('poke_steps', 0, 500)
    assert used.act(1, 1, session=0x33)[4:] == new.act(1, 1, session=0x33)[4:]
    assert used.steps[0] == 0


CALIBRATION = Calibration(
    divider=DividerCorrection(0.05, -0.1, 0.02), curves=8 * (SharpCurve(0.3, 0.02, 0.05, 0.003),)
)
CHANGES = {
    'divider': RobotSettings(divider=7.5),
    'direction': RobotSettings(invert_left=True),
    'steps': RobotSettings(microsteps=32, steps_per_turn=400),
    'radio': RobotSettings(rate='250k', channel=7, address=b'12345'),
    'sensors': RobotSettings(sensors=('GP2Y0A41',) * 8),
    'calibration': CALIBRATION,
    'key': Key(2, core.KEY),
    'no key': Key(2, bytes(16)),
}


def change(robot, what):
    """Store a record or a key over USB."""
    if isinstance(what, Key):
        robot.console(encode(what))
    elif isinstance(what, Calibration):
        robot.store(CALIBRATION_RECORD, eeprom_records.encode_calibration(what))
    else:
        robot.store(SETTINGS_RECORD, robot_settings.encode_settings(what))
    robot.run(700_000)


@pytest.mark.parametrize('what', CHANGES.values(), ids=CHANGES)
def test_stored_records_are_in_effect_as_after_a_boot(library, layout, what):
    """The battery of the divider before was filtered into that of the new one."""
    used, new = core.Robot(library), core.Robot(library)
    used.call('boot', 4, 0)  # as often as the other
    for each in (used, new):
        for channel in range(9):
            each.call('set_adc', channel, 400)
        each.run(1_500_000)
        if what is CHANGES['no key']:
            change(each, CHANGES['key'])
        change(each, what)
    new.call('boot', 4, 0)
    for each in (used, new):
        each.run(200_000)
    copies = 'robot.settings.copies', 'robot.calibration.copies'
    assert not unlike(used, new, layout, (*TIMES, *copies, 'robot.reset_cause', 'robot.counters'))


def test_a_released_emergency_stop_leaves_a_robot_at_rest(library, layout):
    """Released, the robot is as after any command to stand, and the command before is gone."""
    used, new = core.Robot(library), core.Robot(library)
    for each in (used, new):
        each.run(1000)
        each.hello()
        each.drive(4000, 4000, 300_000)
    used.send(used.command(4000, 4000, flags=core.ESTOP))
    used.run(1_000_000)
    new.send(new.command(0, 0, flags=0))
    new.run(1_000_000)
    for each in (used, new):
        each.send(each.command(0, 0, flags=core.CLEAR))
        each.run(100_000)
    assert not unlike(used, new, layout, ('robot.steps', 'robot.rest_us', 'console'))
