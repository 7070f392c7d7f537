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
"""Records of runs that were never run."""

import numpy as np

from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.evaluation.run_record import Record

PAIRS = ('reference', 'measured', 'speeds', 'sent', 'estimated', 'unexplained', 'acceleration')


def record_of(time, *, drive='torque', start=0.0, switches=(), **columns):
    """Return a record of a plant; columns that are not given are zeros, all can be written to."""
    count = len(time)
    found = {name: np.zeros((count, 2)) for name in PAIRS}
    found |= {
        'time': np.array(time, dtype=np.float64),
        'mode': np.zeros(count, dtype=np.int64),
        'limited': np.zeros(count, dtype=np.bool_),
        'terms': np.zeros((count, len(TERM_NAMES), 2)),
    }
    silent = ('',) * count
    return Record(
        {**found, **columns}, drive, start, np.array(switches, dtype=np.float64), silent, silent
    )
