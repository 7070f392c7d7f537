# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What of which bags is played, how fast, and where it begins and ends."""

from dataclasses import dataclass

from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.record.playback.bag import Bag, open_bag
from t3mpc_ros.record.playback.selection import Selection, SelectionError, renamings
from t3mpc_ros.record.playback.tape import Tape, aligned
from t3mpc_ros.settings import SettingError, Settings, setting


@dataclass(frozen=True)
class PlaybackSettings(Settings):
    """Bags, what of them is played, and how."""

    bags: tuple[str, ...] = setting(
        (), 'bags to play, merged by time of receipt: folders or files, MCAP or sqlite3'
    )
    align: bool = setting(False, 'let every bag begin when the first one does')
    bag_offsets: tuple[float, ...] = setting(
        (), 'added to the times of each bag, after align; empty = nothing', unit='s'
    )
    rate: float = setting(1.0, 'seconds of the bag in a second', low=0.01, high=100.0, live=True)
    loop: bool = setting(False, 'begin again at the end')
    start_offset: float = setting(
        0.0,
        'where to begin, after the first message; what latched topics held then comes first',
        unit='s',
        low=0.0,
    )
    duration: float = setting(
        0.0, 'how much to play from there, in time of the bag; 0 = to the end', unit='s', low=0.0
    )
    until: float = setting(
        0.0, 'where to end, after the first message; 0 = at the end', unit='s', low=0.0
    )
    topics: tuple[str, ...] = setting(
        (), 'topics to play; * stands for anything; none here and no regex = all'
    )
    regex: str = setting('', 'play topics whose whole name matches, too; empty = none')
    exclude: tuple[str, ...] = setting((), 'topics not to play; * stands for anything')
    exclude_regex: str = setting('', 'do not play topics whose whole name matches; empty = none')
    remap: tuple[str, ...] = setting((), 'new names of topics, each as old:=new')
    clock_rate: float = setting(
        0.0, 'how often /clock is published; 0 = never', unit='Hz', low=0.0, high=1000.0
    )
    clock_with_messages: bool = setting(False, 'publish /clock before each message, too')
    start_paused: bool = setting(False, 'wait for ~/resume, ~/step or the space bar')
    seek_time: float = setting(
        0.0, 'where ~/seek goes, after the first message', unit='s', low=0.0, live=True
    )
    step_count: int = setting(1, 'messages that ~/step plays', low=1, high=1_000_000, live=True)
    read_ahead: int = setting(1000, 'messages read before they are due', low=1, high=1_000_000)

    def check_together(self) -> None:
        """Raise :class:`SettingError` for an end before the beginning, or an unusable choice."""
        super().check_together()
        if self.until and self.until <= self.start_offset:
            raise SettingError(
                f'until must be later than start_offset ({self.start_offset:g} s): '
                f'got {self.until:g} s'
            )
        if self.bag_offsets and len(self.bag_offsets) != len(self.bags):
            raise SettingError(
                f'bag_offsets must have one number for each of the {len(self.bags)} bags: '
                f'got {len(self.bag_offsets)}'
            )
        try:
            self.selection()
        except SelectionError as error:
            raise SettingError(str(error)) from error

    def selection(self) -> Selection:
        """Return which topics are played, and under which names."""
        return Selection(
            self.topics, self.regex, self.exclude, self.exclude_regex, renamings(self.remap)
        )

    def open_tape(self) -> tuple[Tape, tuple[str, ...]]:
        """Return the opened bags as one, and the files that broke off and are not played.

        Raises
        ------
        RecordError
            A bag cannot be read, or a topic has two types.
        """
        bags: list[Bag] = []
        try:
            for path in self.bags:
                bags.append(open_bag(path))
            offsets_ns = [round(offset * NANOSECONDS) for offset in self.bag_offsets]
            offsets_ns = offsets_ns or [0] * len(bags)
            if self.align and bags:
                offsets_ns = [a + b for a, b in zip(aligned(bags), offsets_ns, strict=True)]
            tape = Tape(bags, offsets_ns, self.selection())
        except Exception:
            for bag in bags:
                bag.close()
            raise
        return tape, tuple(f'{bag.path}/{name}' for bag in bags for name in bag.unfinished)

    def span_ns(self, tape: Tape) -> tuple[int, int]:
        """Return the receipt times between which ``tape`` is played.

        Raises
        ------
        SettingError
            The beginning lies behind the bag's end.
        """
        begin_ns = tape.start_ns + round(self.start_offset * NANOSECONDS)
        if begin_ns > tape.end_ns:
            length = (tape.end_ns - tape.start_ns) / NANOSECONDS
            raise SettingError(
                f'start_offset must be at most the length of the bag, {length:.3f} s: '
                f'got {self.start_offset:g} s'
            )
        ends = [tape.end_ns]
        if self.duration:
            ends.append(begin_ns + round(self.duration * NANOSECONDS))
        if self.until:
            ends.append(tape.start_ns + round(self.until * NANOSECONDS))
        return begin_ns, min(ends)
