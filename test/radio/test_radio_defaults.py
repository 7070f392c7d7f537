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

import yaml

from t3mpc_ros.emulator.emulator import Emulator, EmulatorParameters
from t3mpc_ros.emulator.nrf24_radio import RadioParameters
from t3mpc_ros.radio.link.link_parameters import LinkParameters

ROOT = Path(__file__).resolve().parents[2]
HOST = LinkParameters().configure(0)


def test_firmware_emulator_and_host_have_equal_radio_defaults():
    """The dongle of the emulator is the core of the firmware: it starts with its defaults."""
    assert tuple(RadioParameters()) == HOST[1:]
    parameters = EmulatorParameters()
    assert Emulator(parameters).dongle.radio == RadioParameters()
    assert (parameters.channel, parameters.rate) == (LinkParameters().channel, '1M')


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
