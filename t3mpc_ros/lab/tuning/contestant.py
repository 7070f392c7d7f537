# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A method that takes part in a comparison: where its tuning begins and what may be changed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import re

from t3mpc_ros.lab.rivals.rival import Rival
from t3mpc_ros.lab.tuning.space import Range, Space
from t3mpc_ros.settings import SettingError, Settings


@dataclass(frozen=True)
class Contestant:
    """One line of the table of methods.

    Parameters
    ----------
    name
        As it stands in tables and figures, for example ``'linear MPC'``.
    rival_type
        The controller.
    start
        For each drive the method is meant for, the settings its maker would choose: tuning
        begins there, and never ends worse.
    ranges
        What is tuned, in either drive. All else stays as in ``start``.

    Raises
    ------
    SettingError
        No drive, settings of another table, or ranges that do not fit; names the method.
    """

    name: str
    rival_type: type[Rival]
    start: Mapping[str, Settings]
    ranges: tuple[Range, ...]

    def __post_init__(self) -> None:
        if not short_name(self.name):
            raise SettingError(f'a method must have a name: got {self.name!r}')
        if not self.start:
            raise SettingError(f'{self.name}: there must be start settings for one drive at least')
        try:
            space = self.space
        except SettingError as error:
            raise SettingError(f'{self.name}: {error}') from error
        for drive, settings in self.start.items():
            try:
                space.of(settings)
            except SettingError as error:
                raise SettingError(f'{self.name}, {drive}: {error}') from error

    @property
    def space(self) -> Space:
        """What is searched."""
        return Space(self.rival_type.settings_type, self.ranges)

    @property
    def short(self) -> str:
        """The name for command lines and files."""
        return short_name(self.name)


def short_name(name: str) -> str:
    """Return ``name`` in lower case with one hyphen for whatever is no letter or digit."""
    return re.sub(r'[^a-z0-9]+', '-', name.lower()).strip('-')


def check_names(methods: Sequence[Contestant]) -> None:
    """Raise :class:`ValueError` when two methods could be taken for each other."""
    seen: dict[str, str] = {}
    for method in methods:
        if method.short in seen:
            raise ValueError(
                f'methods must have different names: got {seen[method.short]!r} '
                f'and {method.name!r}'
            )
        seen[method.short] = method.name
