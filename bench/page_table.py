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
"""Makes a table of a page: prints its rows as they are measured, and writes them to the page."""

import argparse
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from t3mpc_ros.evaluation.result_output import replace_section


class PageTable(NamedTuple):
    """A table between the marks ``<!-- NAME -->`` and ``<!-- end of NAME -->`` of a page."""

    name: str
    columns: Sequence[str]
    count: tuple[str, int]  # name and default of the number of trials of a row
    rows: Iterable[tuple[str, Callable[[int], str]]]
    """Name of each row, and what measures it with so many trials."""

    @property
    def head(self) -> tuple[str, str]:
        """The first two lines."""
        return f'| {" | ".join(self.columns)} |', '|---' * len(self.columns) + '|'

    def main(self, description: str | None) -> None:
        """Print the rows that the command line selects, or write them to the page."""
        parser = argparse.ArgumentParser(description=description)
        parser.add_argument(f'--{self.count[0]}', type=int, default=self.count[1], dest='count')
        parser.add_argument('--page', type=Path)
        parser.add_argument('words', nargs='*')
        options = parser.parse_args()
        lines = []
        for name, measure in self.rows:
            if all(word in name for word in options.words):
                lines.append(measure(options.count))
                print(lines[-1], flush=True)
        if options.page is not None:
            marks = f'<!-- {self.name} -->', f'<!-- end of {self.name} -->'
            table = '\n'.join((*self.head, *lines))
            replace_section(options.page, *marks, f'\n{table}\n')
