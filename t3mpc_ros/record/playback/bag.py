# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One bag as messages in their order, each as the bytes that were recorded.

MCAP and sqlite3 bags of ros2 bag, as a folder or a single file, through the ``rosbags`` library:
it looks only into the chunks (MCAP), or the rows of the index over time (sqlite3), that a question
is about.
"""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
import struct
from typing import Any, NamedTuple

from rosbags.rosbag2 import Reader, ReaderError

from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.record.mcap_file import SUFFIX, summarise
from t3mpc_ros.record.metadata import FILE_NAME, contents
from t3mpc_ros.record.quality import UNLIMITED, QualityProfile
from t3mpc_ros.record.schema import RecordError

SQLITE = '.db3'
LATCHED = 'transient_local'

_FIRST_LOOK = NANOSECONDS
"""How far back from a time the first look for earlier messages goes; each next one goes twice."""


class Stored(NamedTuple):
    """One recorded message."""

    stamp_ns: int
    """When it was received."""
    topic: str
    data: bytes


@dataclass(frozen=True)
class Track:
    """One topic of a bag, and what its publishers offered."""

    topic: str
    type_name: str
    profiles: tuple[QualityProfile, ...]
    message_count: int
    encoding: str = 'cdr'

    @property
    def latched(self) -> int:
        """How many publishers kept their last message for those who come late."""
        return sum(profile.durability == LATCHED for profile in self.profiles)


class Part:
    """One file of a bag, or a bag that can only be read as a whole, open for reading."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with _translated(path):
            self._reader = Reader(path)
            self._reader.open()
        count = self._reader.message_count
        self.start_ns: int = self._reader.start_time if count else 0
        self.end_ns: int = self._reader.end_time - 1 if count else -1  # rosbags' end is exclusive
        self.tracks = [_track(connection) for connection in self._reader.connections]

    def messages(
        self, topics: Collection[str], start_ns: int, stop_ns: int | None = None
    ) -> Iterator[Stored]:
        """Yield the messages of some topics from ``start_ns``, before ``stop_ns``, by receipt.

        Raises
        ------
        RecordError
            The file is damaged.
        """
        chosen = [item for item in self._reader.connections if item.topic in topics]
        if not chosen or start_ns > self.end_ns:
            return  # none chosen would mean all to the library
        with _translated(self.path):
            for item, stamp_ns, data in self._reader.messages(chosen, start_ns, stop_ns):
                yield Stored(stamp_ns, item.topic, bytes(data))

    def last_before(self, topic: str, stamp_ns: int, count: int) -> list[Stored]:
        """Return the last ``count`` messages of a topic before a time, or all that there are."""
        stop_ns, look_ns = min(stamp_ns, self.end_ns + 1), _FIRST_LOOK
        found: list[Stored] = []
        while len(found) < count and stop_ns > self.start_ns:
            start_ns = max(stop_ns - look_ns, self.start_ns)
            found = [*self.messages([topic], start_ns, stop_ns), *found]
            stop_ns, look_ns = start_ns, 2 * look_ns
        return found[-count:]

    def close(self) -> None:
        """Let go of the file."""
        self._reader.close()


class Bag:
    """A bag that is open for playing; made by :func:`open_bag`.

    A bag that was split, or continued, is several files whose times may overlap a little.
    """

    def __init__(self, path: Path, parts: list[Part], unfinished: tuple[str, ...]) -> None:
        self.path = path
        self.parts = parts
        self.unfinished = unfinished
        """Files that broke off and are not played."""
        some = [part for part in parts if part.end_ns >= 0]
        self.start_ns = min((part.start_ns for part in some), default=0)
        self.end_ns = max((part.end_ns for part in some), default=-1)
        """When the last message came; before the start when there is none."""
        self.tracks = merged([track for part in parts for track in part.tracks], str(path))

    def close(self) -> None:
        """Let go of the files."""
        for part in self.parts:
            part.close()


def open_bag(path: Path | str) -> Bag:
    """Return the bag in a folder, or in the one file that is given instead.

    Every finished MCAP file of a folder is played, whatever ``metadata.yaml`` says, so that a bag
    whose recorder was killed can be played too. Bags that rosbag2 itself compressed, by file or
    by message, are read through their ``metadata.yaml``.

    Raises
    ------
    RecordError
        There is no bag, nothing finished in it, or it is damaged.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise RecordError(f'there is no bag {path}')
    files, unfinished = _files(path)
    if not files:
        broken = f'; unfinished: {", ".join(unfinished)}: bag recover mends them'
        raise RecordError(f'no finished bag file in {path}{broken if unfinished else ""}')
    return Bag(path, [Part(file) for file in files], unfinished)


def merged(tracks: Collection[Track], where: str) -> dict[str, Track]:
    """Return one track for each topic: counts add up, and so do the different offers.

    Raises
    ------
    RecordError
        A topic has two types.
    """
    result: dict[str, Track] = {}
    for track in tracks:
        before = result.get(track.topic)
        if before is None:
            result[track.topic] = track
            continue
        if before.type_name != track.type_name:
            raise RecordError(
                f'{track.topic} is {before.type_name} and {track.type_name} in {where}: '
                'exclude it, or play one bag at a time'
            )
        new = [profile for profile in track.profiles if profile not in before.profiles]
        result[track.topic] = Track(
            track.topic,
            track.type_name,
            (*before.profiles, *new),
            before.message_count + track.message_count,
            before.encoding if before.encoding != 'cdr' else track.encoding,
        )
    return result


def _files(path: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Return what to read one by one, and the names of files that broke off."""
    if path.is_file():
        if path.suffix == SUFFIX and summarise(path) is None:
            return [], (path.name,)
        return [path], ()
    if (path / FILE_NAME).is_file() and _is_compressed(path):
        return [path], ()
    metadata, unfinished = contents(path)
    found = [path / file.path for file in metadata.files]
    found += sorted(path.glob(f'*{SQLITE}'))
    return found, unfinished


def _is_compressed(folder: Path) -> bool:
    """Whether rosbag2 compressed files or messages, which only ``metadata.yaml`` tells."""
    try:
        with Reader(folder) as reader:
            return bool(reader.compression_format)
    except Exception:  # damaged or stale: the files speak for themselves
        return False


def _track(connection: Any) -> Track:
    return Track(
        connection.topic,
        connection.msgtype,
        tuple(map(_profile, connection.ext.offered_qos_profiles)),
        connection.msgcount,
        connection.ext.serialization_format,
    )


def _profile(offered: Any) -> QualityProfile:
    return QualityProfile(
        history=offered.history.name.lower(),
        depth=max(0, offered.depth),
        reliability=offered.reliability.name.lower(),
        durability=offered.durability.name.lower(),
        deadline_ns=_nanoseconds(offered.deadline),
        lifespan_ns=_nanoseconds(offered.lifespan),
        liveliness=offered.liveliness.name.lower(),
        liveliness_lease_ns=_nanoseconds(offered.liveliness_lease_duration),
        avoid_ros_namespace_conventions=offered.avoid_ros_namespace_conventions,
    )


def _nanoseconds(time: Any) -> int:
    return int(min(time.sec * NANOSECONDS + time.nsec, UNLIMITED))


@contextmanager
def _translated(path: Path) -> Iterator[None]:
    """Turn whatever a damaged file does to the reading library into one error of ours."""
    try:
        yield
    except RecordError:
        raise
    except (ReaderError, OSError, struct.error, ValueError, KeyError, IndexError) as error:
        raise RecordError(f'{path} cannot be read: {error}') from error
    except Exception as error:  # decompressors and the database have roots of their own
        raise RecordError(f'{path} cannot be read: {type(error).__name__}: {error}') from error
