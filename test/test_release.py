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
"""What a reviewer of a release looks at: headers and the description of the package."""

from pathlib import Path

from support.headers import COMMENT, header, sources

ROOT = Path(__file__).resolve().parent.parent


def test_every_header_is_one_that_ament_copyright_recognises():
    """It recognised none of 323."""
    found = sources(ROOT)
    assert len(found) > 600
    for path in found:
        text = path.read_text(encoding='utf-8')
        mark = COMMENT[path.suffix]
        words = f'{path}: run python test/support/headers.py'
        assert header(mark) in text[:1000], words
        assert not text.partition(header(mark))[2].startswith(mark), words
