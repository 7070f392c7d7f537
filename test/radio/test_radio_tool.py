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
"""Bench procedures against the emulator, in virtual time."""

import math
import os
import random
import stat

import pytest
from support.long_tests import few_of
from support.tool_bench import START_NS, ToolBench
import yaml

from t3mpc_ros.parameters.yaml_loader import YamlError
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.authentication import KeyFileError, key_check, read_key
from t3mpc_ros.radio.protocol.codec import decode_from_dongle
from t3mpc_ros.radio.protocol.frames import CommandFlag, StatusFlag
from t3mpc_ros.radio.protocol.framing import FrameDecoder
from t3mpc_ros.radio.tool import (
    channel_scan,
    key_provisioning,
    link_test,
    manoeuvre,
    robot_info,
    robot_settings,
)
from t3mpc_ros.radio.tool.channel_scan import ChannelResult
from t3mpc_ros.radio.tool.eeprom_records import SENSORS
from t3mpc_ros.radio.tool.procedure import ROBOT_BOARD, Procedure, ProcedureError
from t3mpc_ros.radio.tool.robot_info import LogEntry, LogKind, format_log
from t3mpc_ros.radio.tool.robot_settings import RobotSettings

KEY, OTHER = bytes(range(16)), bytes(range(1, 17))
TURN = 3200
KEY_ADDRESS = 8  # of the key in the EEPROM


# -- key ------------------------------------------------------------------------------------------


def test_a_new_key_file_is_private_and_never_overwrites(tmp_path):
    path = tmp_path / 'key'
    keys = iter([bytes(16), KEY])  # zeros are reserved: keys again
    assert key_provisioning.create_key_file(path, lambda size: next(keys)) == key_check(KEY)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert read_key(path) == KEY
    with pytest.raises(KeyFileError, match='never overwritten'):
        key_provisioning.create_key_file(path, os.urandom)
    link = tmp_path / 'link'
    link.symlink_to(tmp_path / 'elsewhere')
    with pytest.raises(KeyFileError, match='exists: a key'):
        key_provisioning.create_key_file(link, os.urandom)
    with pytest.raises(KeyFileError, match='No such file'):
        key_provisioning.create_key_file(tmp_path / 'nowhere' / 'key', os.urandom)
    assert read_key(path) == KEY


def accepts_key(bench, key):
    """Write a key; return whether the robot holds it."""
    return key_provisioning.holds_key(bench.at_robot(key_provisioning.write_key(key)), key)


def test_a_key_is_written_over_usb_and_compared():
    bench = ToolBench()
    state = bench.at_robot(key_provisioning.read_key_state())
    assert 'no key' in key_provisioning.format_key_state(state)
    state = bench.at_robot(key_provisioning.write_key(KEY))
    assert f'{key_check(KEY):08x}' in key_provisioning.format_key_state(state)
    assert key_provisioning.holds_key(state, KEY)
    assert not key_provisioning.holds_key(state, OTHER)
    assert bench.board.read_eeprom(KEY_ADDRESS, 16) == KEY
    assert accepts_key(bench, OTHER)
    assert accepts_key(bench, key_provisioning.ERASE_KEY)
    assert bench.board.read_eeprom(KEY_ADDRESS, 16) == b'\xff' * 16


def test_a_board_reset_by_opening_its_port_has_time_to_start():
    bench = ToolBench()
    bench.emulator.restart_robot()
    assert accepts_key(bench, KEY)
    assert bench.now_ns - START_NS > 1e9


def test_a_damaged_key_is_reported_and_replaced():
    bench = ToolBench(KEY)
    bench.board.write_eeprom(KEY_ADDRESS + 3, bytes([KEY[3] ^ 1]))
    bench.emulator.restart_robot()
    state = bench.at_robot(key_provisioning.read_key_state())
    assert 'damaged' in key_provisioning.format_key_state(state)
    assert accepts_key(bench, KEY)


def test_key_and_settings_are_never_sent_to_the_dongle():
    """The answer that identifies a dongle was dropped: it was taken for an old robot board."""
    bench = ToolBench()
    received = []
    feed = bench.emulator.feed

    def record(data, now_ns):
        received.extend(FrameDecoder().feed(data))
        feed(data, now_ns)

    bench.emulator.feed = record
    writing = robot_settings.write_settings(RobotSettings())
    for script in (key_provisioning.write_key(KEY), robot_settings.read_settings(), writing):
        with pytest.raises(ProcedureError, match='this is the dongle'):
            bench.at_dongle(script, ROBOT_BOARD)
    assert received
    assert not any(KEY in data for data in received)


def test_a_moving_robot_rejects_a_key_with_a_remedy():
    bench = ToolBench()
    bench.each = lambda bench: bench.board.receive(
        bytes([0x24, 9, 0, 0])
        if bench.board.session != 9
        else bytes([0x21, 9, bench.now_ns // 1000 & 0x7F, CommandFlag.ENABLE, 20])
        + bytes(5)
        + bench.board.now_us.to_bytes(4, 'little')
    )
    bench.emulator.run_to(START_NS + 1_000_000)
    bench.each(bench)
    bench.each(bench)
    with pytest.raises(ProcedureError, match='stop the bridge'):
        bench.at_robot(key_provisioning.write_key(KEY))


def test_a_silent_port_fails_with_a_remedy():
    bench = ToolBench()
    bench.emulator.inject('silence', math.inf)
    with pytest.raises(ProcedureError, match='right port'):
        bench.at_dongle(link_test.run_link_test(LinkParameters(), 1))
    assert 4e9 < bench.now_ns - START_NS < 7e9


# -- settings -------------------------------------------------------------------------------------


def write(bench, seed=1, **changes):
    stored = bench.at_robot(robot_settings.read_settings())
    entropy = random.Random(seed).randbytes
    wanted = robot_settings.change_settings(stored, changes, entropy)
    written = bench.at_robot(robot_settings.write_settings(wanted))
    assert written == (frames.SETTINGS_GOOD, wanted)
    return wanted


def host_of(settings):
    """Return link parameters from the parameter file of a robot."""
    content = yaml.safe_load(robot_settings.settings_file(settings))
    # A node rejects what it does not know: settings of the board once ended radio_bridge.
    assert set(content['/**']['ros__parameters']) == {'link'}
    return LinkParameters.from_dict(content['/**']['ros__parameters']['link'])


@pytest.mark.slow
def test_a_new_robot_gets_a_random_address_and_keeps_it():
    addresses = set()
    for seed in range(20):
        bench = ToolBench(erased=True)
        assert bench.at_robot(robot_settings.read_settings()).state == frames.SETTINGS_MISSING
        settings = write(bench, seed)
        assert settings[1:] == RobotSettings()[1:]
        addresses.add(settings.address)
        changed = write(bench, seed + 100, channel=100, microsteps=8)
        assert changed == settings._replace(channel=100, microsteps=8)
        assert bench.at_robot(robot_settings.read_settings()).content == changed
    assert len(addresses) == 20


def test_drawn_addresses_are_receivable_and_no_numbers():
    source = random.Random(1)
    for _ in range(2000):
        text = robot_settings.draw_address(source.randbytes).hex()
        assert not {'00', '55', 'aa', 'ff'} & {text[at : at + 2] for at in range(0, 10, 2)}
        assert isinstance(yaml.safe_load(text), str)
        with pytest.raises(ValueError):
            float(text)


def test_a_settings_file_holds_every_setting():
    source = random.Random(4)
    for _ in range(50):
        settings = RobotSettings(
            robot_settings.draw_address(source.randbytes),
            source.randint(0, 125),
            source.choice(frames.RATES),
            source.choice(frames.POWERS),
            1 << source.randint(0, 8),
            source.randint(20, 10_000),
            source.random() < 0.5,
            source.random() < 0.5,
            source.randint(1000, 13_000) / 1000,
            source.random() < 0.5,
            tuple(source.choices(SENSORS, k=8)),
        )
        text = robot_settings.settings_file(settings)
        assert robot_settings.settings_of_file(yaml.safe_load(text)) == settings
        assert host_of(settings).rate == settings.rate
        other = settings._replace(divider=settings.divider + 1, channel=settings.channel + 1)
        rows = robot_settings.differences(settings, other).splitlines()
        assert [row.partition(':')[0] for row in rows] == ['channel', 'divider']


@pytest.mark.parametrize(
    'old, new, words',
    [
        ('channel: 82', 'channel: 126', 'channel must be from 0 to 125: got 126'),
        ('channel: 82', 'channel: high', 'channel must be a whole number'),
        ('microsteps: 16', 'microsteps: true', 'microsteps must be a whole number'),
        ('microsteps: 16', '', 'lacks the settings: microsteps'),
        ('microsteps: 16', 'microstep: 16', 'unknown settings: microstep'),
        ('GP2Y0A21, ', '', 'sensors must be 8'),
        ('/**', 'robot', 'must be a file of t3mpc robot setup --save'),
        ('link:', 'other:', 'must be a file of t3mpc robot setup --save'),
    ],
)
def test_a_wrong_settings_file_is_rejected_by_name(old, new, words):
    text = robot_settings.settings_file(RobotSettings(bytes.fromhex('c25a33a6e1')))
    assert old in text
    with pytest.raises(YamlError, match=words):
        robot_settings.settings_of_file(yaml.safe_load(text.replace(old, new, 1)))


# -- ping -----------------------------------------------------------------------------------------


def ping(bench, count):
    """Return the measurements of a link test, and the rows of its report by name."""
    seen = bench.at_dongle(link_test.run_link_test(LinkParameters(), count))
    return seen, {row.name: row for row in link_test.evaluate(seen, LinkParameters())}


def test_a_good_link_is_good_in_every_row():
    bench = ToolBench()
    seen, rows = ping(bench, 100)
    assert [row.verdict for row in rows.values()] == [link_test.PASS] * 6
    assert len(seen.pings) == len(seen.cycles) == 100
    assert seen.retransmissions[0] == 200
    assert max(seen.cycles) < 0.01
    assert not bench.board.session
    assert not bench.board.powered
    assert link_test.is_usable([*rows.values()])


def test_losses_cause_retransmissions_and_a_bad_verdict():
    bench = ToolBench()
    bench.emulator.inject('loss', math.inf, 0.4)
    seen, rows = ping(bench, 300)
    assert len(seen.cycles) / 300 == pytest.approx(1 - (1 - 0.6**2) ** 4, abs=0.07)
    assert seen.retransmissions[1] > 40
    assert rows['robot answers by radio'].verdict == link_test.FAIL
    assert rows['retransmissions per packet'].verdict == link_test.POOR
    text = link_test.format_report([*rows.values()])
    assert '10 uF' in text
    assert text.count('try: ') == 2


def test_damaged_frames_are_counted_at_the_dongle():
    bench = ToolBench()
    bench.emulator.inject('flip_bits', math.inf, 0.004)
    seen, _ = ping(bench, 100)
    assert seen.line_errors > 0


MEASURED = link_test.LinkTestResult(100, 100 * (1e-3,), 100 * (5e-3,), (200, *15 * (0,)), 0, None)


@pytest.mark.parametrize(
    'changes, row, verdict, remedy',
    [
        ({'pings': 100 * (16e-3,)}, 'dongle answers over USB', link_test.POOR, 'latency timer'),
        ({'pings': 90 * (1e-3,)}, 'dongle answers over USB', link_test.FAIL, 'another cable'),
        ({'line_errors': 3}, 'frames damaged on the cable', link_test.POOR, 'another cable'),
        ({'cycles': 97 * (5e-3,)}, 'robot answers by radio', link_test.POOR, '10 uF'),
        ({'cycles': ()}, 'robot answers by radio', link_test.FAIL, 't3mpc robot scan'),
        ({'cycles': 100 * (16e-3,)}, 'round trip to the robot', link_test.POOR, 'half a period'),
        ({'cycles': 100 * (21e-3,)}, 'round trip to the robot', link_test.FAIL, 'cycle_rate'),
    ],
)
def test_each_measurement_has_a_verdict_and_a_remedy(changes, row, verdict, remedy):
    rows = link_test.evaluate(MEASURED._replace(**changes), LinkParameters())
    assert {each.name: each.verdict for each in rows if each.verdict != link_test.PASS} == {
        row: verdict
    }
    assert remedy in link_test.format_report(rows)
    assert link_test.is_usable(rows) == (verdict != link_test.FAIL)


def test_the_wrong_port_and_a_dead_chip_are_reported():
    bench = ToolBench()
    with pytest.raises(ProcedureError, match='USB port of the robot board'):
        bench.at_robot(link_test.run_link_test(LinkParameters(), 1))
    bench = ToolBench()
    bench.emulator.inject('radio_dead', math.inf)
    with pytest.raises(ProcedureError, match='radio chip'):
        bench.at_dongle(link_test.run_link_test(LinkParameters(), 1))


# -- scan -----------------------------------------------------------------------------------------


@pytest.mark.parametrize('channel, rate', few_of([(125, '2M'), (0, '1M'), (100, '250k')]))
@pytest.mark.slow
def test_the_scan_finds_the_robot_and_restores_the_radio(channel, rate):
    bench = ToolBench(channel=channel, rate=rate)
    before, seen = bench.radio(), []
    script = channel_scan.scan_channels(
        LinkParameters(), ('250k', '1M', '2M'), lambda *report: seen.append(report)
    )
    (result,) = bench.at_dongle(script)
    assert (result.channel, result.rate) == (channel, rate)
    assert result.answered == result.packets == 20
    assert [report[:2] for report in seen] == [(number + 1, 378) for number in range(378)]
    assert [text for _, _, text in seen if text] == [channel_scan.format_channel(result)]
    assert bench.radio() == before
    good, advice = channel_scan.recommend([result], LinkParameters())
    assert not good
    assert f'link.channel to {channel} and' in advice
    assert channel_scan.recommend([result], LinkParameters(channel=channel, rate=rate))[0]


@pytest.mark.parametrize(
    'script',
    [
        lambda: channel_scan.scan_channels(LinkParameters(), ('2M',), lambda *report: None),
        lambda: link_test.run_link_test(LinkParameters(channel=40), 50),
    ],
)
def test_an_interrupted_procedure_restores_the_radio(script):
    """A second Ctrl-C does not interrupt the restoring, not even when its request is lost."""
    bench = ToolBench(channel=120)
    before, interruptions, dropped = bench.radio(), [], []
    feed = bench.emulator.feed

    def interrupt(bench):
        if bench.radio().channel == 40 or interruptions:
            interruptions.append(bench.now_ns)
            procedure.interrupt(bench.now_ns)

    def lose(data, now_ns):
        if interruptions and not dropped:
            dropped.append(data)
        else:
            feed(data, now_ns)

    bench.each, bench.emulator.feed = interrupt, lose
    procedure = Procedure(script(), decode_from_dongle)
    bench.run(procedure)
    assert (procedure.error, bench.radio()) == ('interrupted', before)
    assert dropped
    assert len(interruptions) > 1


def test_unplugging_the_dongle_ends_the_scan():
    bench = ToolBench(channel=120)

    def pull(bench):
        if bench.radio().channel == 40 and bench.emulator.port_open:
            bench.emulator.inject('close_port', 100.0)

    bench.each = pull
    with pytest.raises(ProcedureError, match='not there'):
        bench.at_dongle(
            channel_scan.scan_channels(LinkParameters(), ('1M',), lambda *report: None)
        )


def test_each_entry_of_the_log_in_words():
    entries = {
        (LogKind.BOOT, 0b10101): 'boot: power on, brown-out, JTAG',
        (LogKind.BOOT, 0b01010): 'boot: reset button or opened port, watchdog',
        (LogKind.BOOT, 0): 'boot: started by a boot loader',
        (LogKind.ESTOP, 0): 'emergency stop',
        (LogKind.EXPIRED, 0): 'stopped by itself: no command in time',
        (LogKind.IMU, 0): 'the inertial sensor does not answer',
        (LogKind.RADIO, 0): 'the radio chip does not answer',
        (LogKind.BATTERY, 8970): 'battery below its cut-off: 9.0 V',
        (LogKind.RECORDS, 3): robot_settings.SETTINGS_TEXTS[3],
        (LogKind.RECORDS, 99): 'records in state 99',
        (LogKind.LOOP, 12345): 'longest pass of the main loop: 12.3 ms',
        (99, 7): 'unknown entry 99: 7',
    }
    assert {kind for kind, _ in entries} >= {*LogKind}
    shown = format_log(tuple(LogEntry(5, kind, 61, value) for kind, value in entries))
    assert shown.splitlines() == [f'     5       61 s  {text}' for text in entries.values()]
    assert format_log(()) == 'the log is empty'


def test_the_recommended_channel_is_the_best():
    answers = {5: 9, 6: 19, 7: 3}
    found = [ChannelResult(k, '1M', count, 20, 0.0) for k, count in answers.items()]
    good, advice = channel_scan.recommend(found, LinkParameters())
    assert not good
    assert advice == (
        'the robot is on another channel or rate than configured: set link.channel to 6 and '
        "link.rate to '1M', or build its firmware for 82 at 1M"
    )
    best = LinkParameters(channel=6)
    assert channel_scan.recommend(found, best)[1].endswith('ping measures the link quality')
    whole = [found[1]._replace(answered=20)]
    assert channel_scan.recommend(whole, best) == (True, 'the robot answers as configured')
    good, advice = channel_scan.recommend([], best)
    assert not good
    assert 'robot switched on' in advice


# -- parameters -----------------------------------------------------------------------------------


@pytest.mark.parametrize('key', [b'', KEY], ids=['open', 'keyed'])
def test_all_parameters_are_read_and_none_is_changed(key):
    bench = ToolBench(key)
    bench.emulator.inject('loss', math.inf, 0.2)
    script = robot_info.read_robot_info(LinkParameters(), key, random.Random(1).randbytes)
    info = bench.at_dongle(script)
    values = [(value.value, value.low, value.high) for value in info.values]
    expected = [(row.default, row.low, row.high) for row in frames.BOARD_PARAMETERS]
    assert values[:-1] == expected[:-1]
    assert values[-1][1:] == expected[-1][1:]  # the count of starts has no default
    assert not bench.board.powered
    lines = robot_info.format_robot_info(info, LinkParameters.from_dict({'robot.max_speed': 5.0}))
    row = next(line for line in lines.splitlines() if line.startswith('max_speed'))
    assert row.split() == ['max_speed', '10000', 'mrad/s', '0', 'to', '19600', '5000']


def test_reading_parameters_keeps_the_session_of_another_host():
    bench = ToolBench(KEY)
    bench.at_dongle(robot_info.read_robot_info(LinkParameters(), KEY, random.Random(1).randbytes))
    session = bench.board.session
    script = robot_info.read_robot_info(LinkParameters(), b'', random.Random(2).randbytes)
    assert len(bench.at_dongle(script).values) == len(frames.BOARD_PARAMETERS)
    assert bench.board.session == session != 0


@pytest.mark.parametrize(
    'here, there, expected',
    [(b'', KEY, 'give the host the key'), (KEY, OTHER, 'keys differ'), (KEY, b'', 'no key')],
)
def test_key_mismatch_is_reported(here, there, expected):
    bench = ToolBench(there)
    with pytest.raises(ProcedureError, match=expected):
        bench.at_dongle(
            robot_info.read_robot_info(LinkParameters(), here, random.Random(1).randbytes)
        )


# -- jog ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'key, wheel, revolutions', [(b'', manoeuvre.LEFT, -0.3), (KEY, manoeuvre.RIGHT, 0.5)]
)
def test_jog_turns_one_wheel_and_disables_the_drives(key, wheel, revolutions):
    bench = ToolBench(key)
    task, reported = bench.jog(wheel, revolutions, key)
    assert task.error == ''
    result = task.result
    assert result.target == revolutions * TURN
    assert abs(result.counted - result.target) <= 10
    assert result.other == 0
    counters = dict(zip((manoeuvre.LEFT, manoeuvre.RIGHT), bench.board.counters, strict=True))
    assert counters.pop(wheel) == result.counted
    assert list(counters.values()) == [0]
    assert not bench.board.powered
    assert reported == []
    text = manoeuvre.format_result(result, wheel, revolutions)
    assert ('forward' in text) == (revolutions > 0)


def test_jog_respects_speed_and_acceleration():
    bench, speeds = ToolBench(), []
    bench.each = lambda bench: speeds.append((bench.now_ns, bench.board.speeds[0] / 1e6))
    task, _ = bench.jog(manoeuvre.LEFT, 1.0, speed=1.5)
    assert task.error == ''
    assert max(speed for _, speed in speeds) == pytest.approx(1.5, abs=0.001)
    for (before_ns, before), (after_ns, after) in zip(speeds, speeds[1:], strict=False):
        assert abs(after - before) <= 8.0 * ((after_ns - before_ns) / 1e9 + 2e-3)


def test_an_interrupted_jog_stops_and_disables_the_drives():
    bench = ToolBench()
    left, entropy = manoeuvre.LEFT, random.Random(1).randbytes
    task = manoeuvre.Jog(LinkParameters(), b'', entropy, left, 5.0, 3.0, print)

    def interrupt(bench):
        if bench.board.counters[0] > 2000:
            task.interrupt(bench.now_ns)

    bench.each = interrupt
    bench.run(task)
    assert task.error == 'interrupted'
    assert 2000 < task.result.counted < 3000
    assert task.result.counted == bench.board.counters[0]
    assert bench.board.speeds == (0, 0)
    assert not bench.board.powered


@pytest.mark.parametrize(
    'fault, expected', [('button', 'emergency stop'), ('jam', 'does not answer')]
)
def test_a_blocked_jog_ends_with_the_reason(fault, expected):
    bench = ToolBench()

    def block(bench):
        if bench.board.counters[0] > 1000 and not bench.emulator.faults.active(fault):
            bench.emulator.inject(fault, 1000.0)

    bench.each = block
    task, _ = bench.jog(manoeuvre.LEFT, 5.0)
    assert expected in task.error
    bench.emulator.run_to(bench.now_ns + 1_000_000_000)
    assert bench.board.speeds == (0, 0)


def test_jog_reports_a_robot_that_does_not_answer():
    bench = ToolBench()
    bench.emulator.inject('jam', math.inf)
    task, reported = bench.jog(manoeuvre.LEFT, 1.0)
    assert 'does not answer' in task.error
    assert reported == [task.error]
    assert task.result is None


@pytest.mark.slow
def test_each_of_two_robots_follows_its_own_host_only():
    """Both receive every packet of the dongle; before they are set up, neither moves."""
    benches = [ToolBench(erased=True) for _ in range(2)]
    for bench in benches:
        bench.jog(manoeuvre.LEFT, 0.2)
        assert bench.board.counters == (0, 0)
    hosts = [host_of(write(bench, seed)) for seed, bench in enumerate(benches)]
    for number, host in enumerate(hosts):
        before = [bench.board.counters for bench in benches]
        for bench in benches:
            bench.jog(manoeuvre.LEFT, 0.2, link=host)
        moved = [bench.board.counters != old for bench, old in zip(benches, before, strict=True)]
        assert moved == [number == 0, number == 1]


def test_unplugging_the_dongle_ends_the_jog_and_stops_the_robot():
    bench = ToolBench()

    def pull(bench):
        if bench.board.counters[1] > 1000 and bench.emulator.port_open:
            bench.emulator.inject('close_port', 1000.0)

    bench.each = pull
    task, _ = bench.jog(manoeuvre.RIGHT, 5.0)
    assert 'not there' in task.error
    bench.emulator.run_to(bench.now_ns + 1_000_000_000)
    assert bench.board.speeds == (0, 0)
    assert bench.board.status & StatusFlag.TTL_EXPIRED


def test_settings_survive_a_restart_of_the_robot():
    bench = ToolBench(erased=True)
    settings = write(bench)
    bench.emulator.restart_robot()
    assert bench.at_robot(robot_settings.read_settings()).content == settings
