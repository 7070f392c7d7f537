# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Summary of a bag: files, topics, QoS, metadata records and attachments."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.rosbag2 import ReaderError
from rosbags.typesys import Stores, get_typestore

from t3mpc_ros.bag.mcap_file import (
    MAGIC,
    MCAP_SUFFIX,
    ChannelSummary,
    FileSummary,
    read_file_summary,
)
from t3mpc_ros.bag.qos import QosError, profiles_from_yaml
from t3mpc_ros.bag.schema import BagError
from t3mpc_ros.geometry.types import NANOSECONDS

_SQLITE_SUFFIX, _ROS1_SUFFIX = '.db3', '.bag'


@dataclass
class TopicInfo:
    """Topic of a bag."""

    name: str
    type_name: str
    message_count: int = 0
    qos_profiles: list[str] = field(default_factory=list)
    """Distinct profiles of the publishers, as text."""


@dataclass(frozen=True)
class AttachmentInfo:
    """Attachment of a bag."""

    file: str
    name: str
    media_type: str
    size: int
    """Bytes."""


@dataclass(frozen=True)
class BagInfo:
    """Content of a bag; receive times in nanoseconds since 1970."""

    path: str
    storage: str
    files: Mapping[str, int]
    """Size of each complete file in bytes."""
    incomplete_files: Mapping[str, int]
    """Size of each MCAP file without a valid end in bytes; such files need a recovery."""
    message_count: int
    start_ns: int
    """0 without messages."""
    duration_ns: int
    topics: tuple[TopicInfo, ...]
    metadata_records: Mapping[str, Mapping[str, str]]
    """Tables of text by title; the newest of each title."""
    attachments: tuple[AttachmentInfo, ...]

    def rate(self, topic: TopicInfo) -> float:
        """Return the mean rate of a topic in messages per second; 0 for a bag without duration."""
        seconds = self.duration_ns / NANOSECONDS
        return topic.message_count / seconds if seconds > 0.0 else 0.0


def read_bag_info(path: Path | str) -> BagInfo:
    """Return the content of a bag: an MCAP file, a folder of MCAP files, or an sqlite3 bag.

    Raises
    ------
    BagError
        The bag does not exist, or all of its files need a recovery.
    """
    path = Path(path)
    if not path.exists():
        raise BagError(f'{path} does not exist')
    files = sorted(path.glob(f'*{MCAP_SUFFIX}')) if path.is_dir() else [path]
    if path.is_file() and path.suffix in (_SQLITE_SUFFIX, _ROS1_SUFFIX):
        files = []
    if not files:
        return _info_through_rosbags(path)
    summaries = {file: read_file_summary(file) for file in files}
    complete = {file: summary for file, summary in summaries.items() if summary}
    incomplete = [file for file, summary in summaries.items() if summary is None]
    if not complete:
        if not any(_has_mcap_magic(file) for file in incomplete):
            raise BagError(f'{path} contains no MCAP file and no sqlite3 bag')
        names = ', '.join(file.name for file in incomplete)
        raise BagError(
            f'no file of {path} is complete ({names}): `t3mpc bag recover {path}` writes their '
            'messages to a new bag'
        )
    return _mcap_info(path, complete, incomplete)


def _mcap_info(
    path: Path, files: Mapping[Path, FileSummary], incomplete: Iterable[Path]
) -> BagInfo:
    spans = [(s.start_ns, s.end_ns) for s in files.values() if s.message_count]
    start = min((first for first, _ in spans), default=0)
    topics: dict[str, TopicInfo] = {}
    metadata_records: dict[str, Mapping[str, str]] = {}
    for summary in sorted(files.values(), key=lambda summary: summary.start_ns):
        for channel in summary.channels:
            topic = topics.setdefault(channel.topic, TopicInfo(channel.topic, channel.type_name))
            topic.message_count += channel.message_count
            topic.qos_profiles += [q for q in _qos_texts(channel) if q not in topic.qos_profiles]
        metadata_records |= {
            title: table for title, table in summary.metadata_records.items() if title != 'rosbag2'
        }
    return BagInfo(
        path=str(path),
        storage='mcap',
        files={file.name: file.stat().st_size for file in files},
        incomplete_files={file.name: file.stat().st_size for file in incomplete},
        message_count=sum(summary.message_count for summary in files.values()),
        start_ns=start,
        duration_ns=max((last for _, last in spans), default=0) - start,
        topics=tuple(topics[name] for name in sorted(topics)),
        metadata_records=metadata_records,
        attachments=tuple(item for file in files for item in _attachments(file)),
    )


def _has_mcap_magic(path: Path) -> bool:
    with path.open('rb') as file:
        return file.read(len(MAGIC)) == MAGIC


def _attachments(path: Path) -> list[AttachmentInfo]:
    with path.open('rb') as file:
        summary = make_reader(file).get_summary()
        return [
            AttachmentInfo(path.name, item.name, item.media_type, item.data_size)
            for item in (summary.attachment_indexes if summary else ())
        ]


def _qos_texts(channel: ChannelSummary) -> list[str]:
    try:
        profiles = profiles_from_yaml(channel.profiles_text)
    except QosError:
        return ['unknown']
    return [_qos_text(profile) for profile in profiles]


def _qos_text(profile: Any) -> str:
    """Return reliability, durability, history and depth of a profile (also of rosbags)."""
    policies = [
        getattr(value, 'name', str(value)).lower()
        for value in (profile.reliability, profile.durability, profile.history)
    ]
    return f'{", ".join(policies)} {profile.depth}'


def _storage(paths: Iterable[Path]) -> str:
    """Return the name of the format of files that are not MCAP."""
    suffixes = {path.suffix for path in paths}
    if _SQLITE_SUFFIX in suffixes:
        return 'sqlite3'
    return 'ROS 1' if _ROS1_SUFFIX in suffixes else 'other'


def _info_through_rosbags(path: Path) -> BagInfo:
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
        reader.open()
    except (AnyReaderError, ReaderError, OSError, ValueError) as error:
        raise BagError(f'{path} cannot be read: {error}') from error
    topics: dict[str, TopicInfo] = {}
    try:
        for item in reader.connections:
            topic = topics.setdefault(item.topic, TopicInfo(item.topic, item.msgtype))
            topic.message_count += item.msgcount
            offers = [_qos_text(one) for one in getattr(item.ext, 'offered_qos_profiles', ())]
            topic.qos_profiles += [offer for offer in offers if offer not in topic.qos_profiles]
        some = reader.message_count > 0
        paths = sorted(path.glob(f'*{_SQLITE_SUFFIX}')) if path.is_dir() else [path]
        return BagInfo(
            path=str(path),
            storage=_storage(paths),
            files={file.name: file.stat().st_size for file in paths},
            incomplete_files={},
            message_count=reader.message_count,
            start_ns=reader.start_time if some else 0,
            duration_ns=reader.end_time - 1 - reader.start_time if some else 0,
            topics=tuple(topics[name] for name in sorted(topics)),
            metadata_records={},
            attachments=(),
        )
    finally:
        reader.close()
