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
"""Radio defaults are equal in firmware, emulator, host and documents."""

from pathlib import Path
import re

import yaml

from t3mpc_ros.emulator.emulator import Emulator, EmulatorParameters
from t3mpc_ros.emulator.link.radio_channel import RadioParameters
from t3mpc_ros.radio.link.link_parameters import LinkParameters

ROOT = Path(__file__).resolve().parents[2]
HOST = LinkParameters().configure(0)


def defined(header, name):
    """Return the value of a macro in a header, with continuation lines joined."""
    text = (ROOT / 'firmware' / 'core' / header).read_text().replace('\\\n', ' ')
    (value,) = re.findall(rf'^ *#define {name}\s+(.*?)(?://.*)?$', text, re.MULTILINE)
    return value.strip()


def test_firmware_and_host_have_equal_radio_defaults():
    channel, rate = (int(defined('t3_port.h', f'T3_RADIO_{name}')) for name in ('CHANNEL', 'RATE'))
    delays = re.fullmatch(
        r'\(\(rate\) == 0 \? (\d+)u : (\d+)u\)',
        defined('t3_port.h', r'T3_RETRY_DELAY_AT\(rate\)'),
    )
    slow, usual = map(int, delays.groups())
    assert (slow, usual) == tuple(
        LinkParameters(rate=rate).configure(0).retry_delay for rate in ('250k', '1M')
    )
    everything = re.fullmatch(
        r'\{T3_RADIO_CHANNEL, T3_RADIO_RATE, (\d), T3_RETRY_DELAY, (\d), \{(.*)\}\}',
        defined('t3_port.h', 'T3_RADIO_DEFAULTS'),
    )
    power, retries, letters = everything.groups()
    address = ''.join(re.findall("'(.)'", letters)).encode()
    there = (channel, rate, int(power), usual, int(retries), address)
    assert there == HOST[1:]


def test_emulator_and_host_have_equal_radio_defaults():
    assert tuple(RadioParameters()) == HOST[1:]
    assert Emulator(EmulatorParameters()).dongle.radio == RadioParameters()
    parameters = EmulatorParameters()
    assert (parameters.channel, parameters.rate) == (
        LinkParameters().channel,
        LinkParameters().rate,
    )


def test_the_documents_name_the_same_radio_defaults():
    text = (ROOT / 'docs' / 'radio.md').read_text()
    letters = HOST.address.hex(' ')
    rates = {0: '250 kbit/s', 1: '1 Mbit/s', 2: '2 Mbit/s'}
    sentence = (
        f'both ends start with `{HOST.address.decode()}` ({letters}) on channel {HOST.channel} at '
        f'{rates[HOST.rate]}'
    )
    assert sentence in ' '.join(text.split())


def test_no_configuration_changes_one_end_alone():
    for path in (ROOT / 'config').glob('*.yaml'):
        for content in yaml.safe_load(path.read_text()).values():
            link = content['ros__parameters'].get('link', {})
            for name, value in link.items():
                if name in ('channel', 'rate', 'address'):
                    assert value == getattr(LinkParameters(), name), path.name
