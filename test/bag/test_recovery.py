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
"""Recovery of truncated and damaged files of any writer: whole chunks, and nothing else."""

from dataclasses import dataclass
import io
import itertools
from itertools import product
import json
import os
import random
import re
import sqlite3

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType, Writer
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore
from support.bag_files import metadata_of, topics_of
from support.long_tests import few_of

from t3mpc_ros.bag import recovery
from t3mpc_ros.bag.mcap_file import MAGIC, read_mcap_file
from t3mpc_ros.bag.message_definitions import MessageDefinitions
from t3mpc_ros.bag.qos import QosProfile
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.recording_metadata import lost_spans, message_losses
from t3mpc_ros.bag.recovery import (
    Damage,
    FileResult,
    RecoveryOutputError,
    RecoveryResult,
    TopicResult,
    UnreadableError,
    default_output,
    recover_bag,
    recover_file,
)
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.cli.bag import main as bag_main
from t3mpc_ros.cli.bag import size_text

START = 1_700_000_000_000_000_000
TEXT, NUMBER = 'std_msgs/msg/String', 'std_msgs/msg/Float64'
TOPICS = {'/a': TEXT, '/b/c': TEXT, '/n': NUMBER}
DETAILS = {'settings': {'law.gain': '8.0'}, 'provenance': {'commit': 'abc', 'note': 'µ ∞'}}


def payload(kind, rng):
    """Return a random, incompressible message in CDR."""
    if kind == NUMBER:
        return b'\0\1\0\0' + rng.randbytes(8)
    text = rng.randbytes(rng.randrange(20, 200)).hex().encode() + b'\0'
    return b'\0\1\0\0' + len(text).to_bytes(4, 'little') + text


def messages(count, seed=1):
    """Return ``count`` messages as (topic, log time, publish time, sequence, data)."""
    rng = random.Random(seed)
    sequence = dict.fromkeys(TOPICS, 0)
    result = []
    for i in range(count):
        topic = rng.choice(list(TOPICS))
        now = START + i * 10_000_000
        result.append((topic, now, now - 123, sequence[topic], payload(TOPICS[topic], rng)))
        sequence[topic] += 1
    return result


def own_bag(folder, count=800, chunk_bytes=4_000):
    """Return the file of a complete bag written by ``BagWriter``."""
    with BagWriter(folder, metadata_records=DETAILS, chunk_bytes=chunk_bytes) as bag:
        for topic, kind in TOPICS.items():
            bag.add_topic(topic, kind, [QosProfile(depth=7)])
        bag.add_topic('/quiet', NUMBER)
        for topic, log_time, publish_time, _, data in messages(count):
            bag.write(topic, log_time, publish_time, data)
    return bag.path


def foreign_file(count=200, extras=True, **options):
    """Return the bytes of a file of the mcap library, with attachments and metadata records."""
    output = io.BytesIO()
    writer = Writer(output, **{'chunk_size': 3_000} | options)
    writer.start('ros2', 'other writer')
    definitions = MessageDefinitions()
    channels = {}
    for i, (topic, log_time, publish_time, sequence, data) in enumerate(messages(count)):
        if topic not in channels:
            schema = writer.register_schema(
                TOPICS[topic], 'ros2msg', definitions.schema(TOPICS[topic]).encode()
            )
            about = {'offered_qos_profiles': '', 'who': 'µ'}
            channels[topic] = writer.register_channel(topic, 'cdr', schema, about)
        writer.add_message(channels[topic], log_time, data, publish_time, sequence)
        if extras and i % 50 == 20:
            writer.add_metadata(f'note {i}', {'at': str(i)})
            writer.add_attachment(log_time, log_time, f'{i}.bin', 'application/x', bytes(i))
    writer.finish()
    return output.getvalue()


@dataclass
class Inside:
    """Content of a complete file in its order."""

    items: list
    """Messages as in :func:`messages`, between them attachments and metadata records."""
    channels: dict

    @property
    def messages(self):
        return [item for item in self.items if isinstance(item, tuple)]


def inside(content):
    """Return the records of ``content``; the mcap library verifies every checksum."""
    found = Inside([], {})
    for record in StreamReader(io.BytesIO(content), validate_crcs=True).records:
        if isinstance(record, Channel):
            found.channels[record.id] = record
        elif isinstance(record, Message):
            topic = found.channels[record.channel_id].topic
            found.items.append(
                (topic, record.log_time, record.publish_time, record.sequence, record.data)
            )
        elif isinstance(record, Metadata | Attachment):
            found.items.append(record)
    return found


def chunk_ends(content):
    """Return (end of the chunk in the file, number of messages up to it) of each chunk."""
    ends = [(0, 0)]
    for entry in make_reader(io.BytesIO(content)).get_summary().chunk_indexes:
        start, end = entry.chunk_start_offset, entry.chunk_start_offset + entry.chunk_length
        chunk = Chunk.read(ReadDataStream(io.BytesIO(content[start + 9 : end])))
        count = sum(isinstance(record, Message) for record in breakup_chunk(chunk))
        ends.append((end, ends[-1][1] + count))
    return ends


def end_of_data(content):
    """Return the position of the data-end record; the summary begins 13 bytes later."""
    return int.from_bytes(content[-28:-20], 'little') - 13


def salvaged(content):
    """Return the result and the written bytes."""
    output = io.BytesIO()
    outcome = recover_file(io.BytesIO(content), output, 'file')
    return outcome, output.getvalue()


@pytest.fixture(scope='module')
def own(tmp_path_factory):
    return own_bag(tmp_path_factory.mktemp('own') / 'run').read_bytes()


# -- truncated files ----------------------------------------------------------------------------


@pytest.mark.parametrize('places', few_of([25, 1000]))
@pytest.mark.slow
def test_a_truncated_bag_keeps_its_complete_chunks_only(places, own):
    whole, ends, end = inside(own).items, chunk_ends(own), end_of_data(own)
    assert len(ends) > 30
    rng = random.Random(6)
    for cut in [8, len(own) - 1, *(rng.randrange(8, len(own)) for _ in range(places - 2))]:
        outcome, content = salvaged(own[:cut])
        found = inside(content)
        assert found.items == whole[: len(found.items)], cut
        assert len(found.messages) == max(count for place, count in ends if place <= cut), cut
        assert len(found.messages) == sum(topic.kept for topic in outcome.topics.values())
        assert outcome.clean == (cut >= end + 13), cut
        assert make_reader(io.BytesIO(content)).get_summary().statistics is not None


@pytest.mark.parametrize(
    'options',
    [
        {'compression': CompressionType.LZ4},
        {'compression': CompressionType.NONE},
        {'use_chunking': False},
        {'enable_crcs': False, 'index_types': IndexType.NONE, 'use_statistics': False},
    ],
    ids=['lz4', 'none', 'unchunked', 'no_checksum'],
)
@pytest.mark.slow
def test_truncated_file_of_another_writer_keeps_whole_records(options):
    content = foreign_file(**options)
    whole, end = inside(content).items, end_of_data(content)
    rng = random.Random(7)
    for cut in [8, *(rng.randrange(8, len(content)) for _ in range(39))]:
        outcome, result = salvaged(content[:cut])
        found = inside(result)
        assert found.items == whole[: len(found.items)], cut
        if 'use_chunking' in options:  # all complete messages before the cut are kept
            missing = whole[len(found.items) :]
            bodies = [item[4] if isinstance(item, tuple) else None for item in missing]
            assert not any(body and body in content[:cut] for body in bodies), cut
        assert outcome.clean == (cut >= end + 13), cut


def test_headers_channels_and_schemas_come_back_as_they_were():
    for options in ({}, {'use_chunking': False}):
        content = foreign_file(**options)
        before, after = inside(content), inside(salvaged(content)[1])
        assert list(after.channels.values()) == list(before.channels.values())
        summary = make_reader(io.BytesIO(salvaged(content)[1])).get_summary()
        assert summary.schemas == make_reader(io.BytesIO(content)).get_summary().schemas
    header = make_reader(io.BytesIO(salvaged(content)[1])).get_header()
    assert (header.profile, header.library) == ('ros2', 'other writer; recovered by t3mpc_ros')


# -- damaged files ------------------------------------------------------------------------------


def flipped(content, rng, count=1):
    damaged = bytearray(content)
    for _ in range(count):
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def is_subsequence(part, whole):
    remaining = iter(whole)
    return all(item in remaining for item in part)


@pytest.mark.parametrize(
    'kind, trials', few_of([*product(('own', 'lz4', 'none'), (20,)), ('own', 300)], 3)
)
@pytest.mark.slow
def test_flipped_bits_never_change_a_checksummed_message(own, kind, trials):
    compression = CompressionType.LZ4 if kind == 'lz4' else CompressionType.NONE
    content = own if kind == 'own' else foreign_file(extras=False, compression=compression)
    whole = inside(content).messages
    largest = max(b[1] - a[1] for a, b in itertools.pairwise(chunk_ends(content)))
    rng = random.Random(8)
    for trial in range(trials):
        outcome, result = salvaged(flipped(content, rng))
        kept = inside(result).messages
        assert is_subsequence(kept, whole), trial
        assert len(kept) >= len(whole) - largest, trial  # one bit damages at most one chunk
        lost = sum(topic.lost for topic in outcome.topics.values())
        assert len(kept) + lost == len(whole), trial
        assert lost == 0 or not outcome.clean


@pytest.mark.slow
def test_many_flipped_bits_never_crash_the_recovery(own):
    rng = random.Random(9)
    unchunked = foreign_file(use_chunking=False)
    whole = inside(own).messages
    for trial in range(20):
        for content, covered in ((own, True), (unchunked, False)):
            _, result = salvaged(flipped(content, rng, 1 + trial % 20))
            kept = inside(result).messages
            assert not covered or is_subsequence(kept, whole), trial


HEADS = [(0, bytes([Opcode.CHUNK ^ 1 << bit])) for bit in range(8)]
HEADS += [(1, length.to_bytes(8, 'little')) for length in (0, 5, 2**20, 2**40, 2**64 - 1)]
"""Offset and bytes: another kind of record, or another length."""


@pytest.mark.parametrize(('offset', 'head'), HEADS)
def test_a_damaged_head_costs_only_its_chunk(offset, head, own):
    """The scan must not continue where a damaged length says that the chunk ends.

    As an index record, a chunk was not counted as lost; as a footer, the rest was lost as well.
    """
    ends, whole = chunk_ends(own), inside(own).messages
    start = make_reader(io.BytesIO(own)).get_summary().chunk_indexes[9].chunk_start_offset
    damaged = bytearray(own)
    damaged[start + offset : start + offset + len(head)] = head
    outcome, result = salvaged(bytes(damaged))
    assert inside(result).messages == [*whole[: ends[9][1]], *whole[ends[10][1] :]]
    assert sum(topic.lost for topic in outcome.topics.values()) == ends[10][1] - ends[9][1]
    (damage,) = outcome.damages
    assert (damage.start, outcome.clean) == (start, False)
    if offset:  # Without index nothing tells where the next chunk begins, and the rest is lost.
        outcome, result = salvaged(bytes(damaged[: end_of_data(own)]))
        assert inside(result).messages == whole[: ends[9][1]]
        assert outcome.damages[0].end == end_of_data(own)
        assert not outcome.exact


def test_a_lost_chunk_is_counted_per_topic_with_its_time(own):
    entry = make_reader(io.BytesIO(own)).get_summary().chunk_indexes[4]
    damaged = bytearray(own)
    damaged[entry.chunk_start_offset + entry.chunk_length - 1] ^= 1
    before = inside(own).messages
    for content, exact in ((damaged, True), (damaged[: end_of_data(own)], False)):
        outcome, result = salvaged(bytes(content))
        there = set(inside(result).messages)
        missing = [item for item in before if item not in there]
        assert outcome.exact == exact
        for topic in outcome.topics.values():
            lost = sum(item[0] == topic.name for item in missing)
            assert topic.lost == (lost if exact else 0)
        (damage,) = outcome.damages
        assert damage.span_ns == (entry.message_start_time, entry.message_end_time)
        assert damage.messages == (len(missing) if exact else None)
        assert damage.size >= entry.chunk_length


def test_channels_of_a_lost_first_chunk_are_found_in_the_summary(own):
    entry = make_reader(io.BytesIO(own)).get_summary().chunk_indexes[0]
    damaged = bytearray(own)
    damaged[entry.chunk_start_offset + entry.chunk_length - 1] ^= 1
    first = chunk_ends(own)[1][1]
    _, result = salvaged(bytes(damaged))
    assert inside(result).messages == inside(own).messages[first:]
    # Without the summary the channels are unknown, and the messages are reported as lost.
    outcome, result = salvaged(bytes(damaged[:100_000]))
    assert inside(result).messages == []
    assert any('names are lost' in damage.reason for damage in outcome.damages)


def test_a_damaged_chunk_of_a_file_without_index_is_a_loss(own):
    """Between the places of an index nothing is lost; without index that says nothing."""
    entry = make_reader(io.BytesIO(own)).get_summary().chunk_indexes[4]
    damaged = bytearray(own[: end_of_data(own) + 13])
    assert salvaged(bytes(damaged))[0].clean
    damaged[entry.chunk_start_offset + entry.chunk_length - 1] ^= 1
    outcome, _ = salvaged(bytes(damaged))
    assert (outcome.ended, outcome.clean) == (True, False)


@pytest.mark.parametrize('checked', [True, False])
def test_messages_without_a_checksum_are_counted(checked):
    outcome, _ = salvaged(foreign_file(enable_crcs=checked))
    for topic in outcome.topics.values():
        assert topic.kept > 0
        assert topic.unchecked == (0 if checked else topic.kept)


def test_zeros_at_the_end_are_no_records(own):
    """A power failure leaves a file with its full size but without its last blocks."""
    outcome, result = salvaged(own[:30_000] + bytes(40_000))
    kept = inside(result).messages
    assert kept == inside(own).messages[: len(kept)]
    assert len(kept) == max(count for place, count in chunk_ends(own) if place <= 30_000)
    assert not outcome.clean


def test_other_file_formats_are_rejected():
    for content in (b'', b'\x89PNG\r\n' + bytes(500), random.Random(2).randbytes(20_000)):
        with pytest.raises(UnreadableError, match='contains no MCAP data'):
            salvaged(content)


# -- bags and the command line ------------------------------------------------------------------


def torn_bag(folder, cut=-20_000):
    path = own_bag(folder)
    path.write_bytes(path.read_bytes()[:cut])
    return path


def read_anyhow(folder):
    with AnyReader([folder]) as reader:
        return [(item.topic, stamp, bytes(data)) for item, stamp, data in reader.messages()]


def test_recovered_bag_opens_everywhere_and_input_is_unchanged(tmp_path, own):
    path = torn_bag(tmp_path / 'run')
    before = {item: item.read_bytes() for item in path.parent.iterdir()}
    result = recover_bag(path.parent, tmp_path / 'new')
    assert {item: item.read_bytes() for item in path.parent.iterdir()} == before
    target = tmp_path / 'new' / path.name
    kept = inside(target.read_bytes())
    assert [(m[0], m[1], m[4]) for m in kept.messages] == read_anyhow(tmp_path / 'new')
    assert read_mcap_file(target).message_count == len(kept.messages) == result.kept > 300
    assert metadata_of(tmp_path / 'new')['message_count'] == result.kept
    assert topics_of(tmp_path / 'new')[0][2] == [QosProfile(depth=7).to_mapping()]
    with open_bag(tmp_path / 'new') as reader:
        assert reader.metadata_records == DETAILS
        assert reader.topics['/n'].message_count == result.topics['/n'].kept
        assert reader.series('/n', {'n': 'data'})['n'].size == result.topics['/n'].kept
    assert not result.clean


def test_intact_files_are_copied_and_damaged_ones_rewritten(tmp_path):
    folder = tmp_path / 'run'
    torn_bag(folder)
    sound = own_bag(folder)
    (folder / 'run_2.mcap').write_bytes(b'')
    own_bag(folder / 'snapshots' / 'one')
    result = recover_bag(folder, tmp_path / 'new')
    assert [(file.name, file.copied) for file in result.files] == [
        ('run_0.mcap', False),
        ('run_1.mcap', True),
        ('run_2.mcap', False),
    ]
    assert (tmp_path / 'new' / sound.name).read_bytes() == sound.read_bytes()
    names = {item.name for item in (tmp_path / 'new').iterdir()}
    assert names == {'run_0.mcap', 'run_1.mcap', 'metadata.yaml'}
    again = recover_bag(tmp_path / 'new', tmp_path / 'again')
    assert again.clean
    for item in (tmp_path / 'new').iterdir():
        assert (tmp_path / 'again' / item.name).read_bytes() == item.read_bytes()


def test_complete_file_with_a_damaged_chunk_is_not_copied(tmp_path):
    path = own_bag(tmp_path / 'run')
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)
    assert read_mcap_file(path) is not None  # its summary is valid
    result = recover_bag(path, tmp_path / 'new')
    assert not result.files[0].copied
    assert not result.clean
    with open_bag(tmp_path / 'new') as bag:
        records = bag.metadata_records
    lost = {name: topic.lost for name, topic in result.topics.items() if topic.lost}
    assert message_losses(records)['damaged'] == lost
    assert sum(lost.values()) == result.lost > 0
    assert lost_spans(records) == [each.span_ns for each in result.files[0].damages]
    losses = {'losses': {'lost /a': '3'}, 'losses in b': {'damaged /a': '2', 'damaged': '2'}}
    more = message_losses({**records, **losses})
    assert more['lost'] == {'/a': 3}
    assert more['damaged']['/a'] == lost.get('/a', 0) + 2
    assert result.lost + result.kept == 800
    assert result.lost_seconds < 1.0
    assert len(read_anyhow(tmp_path / 'new')) == result.kept


def test_an_output_that_could_harm_the_input_is_refused(tmp_path):
    path = torn_bag(tmp_path / 'run')
    (tmp_path / 'full').mkdir()
    (tmp_path / 'full' / 'x').write_text('')
    refused = [
        (path, path.parent),
        (path.parent, path.parent),
        (path.parent, path.parent / 'inside'),
        (path, tmp_path / 'full'),
        (path, path),
    ]
    for source, output in refused:
        with pytest.raises(RecoveryOutputError, match='choose'):
            recover_bag(source, output)
    assert {item.name for item in path.parent.iterdir()} == {'run_0.mcap', 'metadata.yaml'}


def test_a_full_disk_leaves_no_half_file(tmp_path, monkeypatch):
    path = torn_bag(tmp_path / 'run')

    def fail(number):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr('os.fsync', fail)
    with pytest.raises(OSError, match='No space'):
        recover_bag(path, tmp_path / 'new')
    assert list((tmp_path / 'new').iterdir()) == []


def test_recover_command_reports_messages_and_exit_code(tmp_path, capsys):
    path = own_bag(tmp_path / 'run')
    assert bag_main(['recover', str(path), '--output', str(tmp_path / 'clean')]) == 0
    assert 'sound, copied' in capsys.readouterr().out
    path.write_bytes(path.read_bytes()[:-20_000])
    assert bag_main(['recover', str(path.parent)]) == 3
    printed = capsys.readouterr().out
    assert default_output(path.parent) == tmp_path / 'run_recovered'
    assert len(read_anyhow(tmp_path / 'run_recovered')) > 300
    assert 'the file has no end' in printed
    assert 'std_msgs/msg/String' in printed
    assert bag_main(['recover', str(path.parent)]) == 2  # the output exists now
    assert 'not empty' in capsys.readouterr().err
    (tmp_path / 'text').write_text('hello')
    assert bag_main(['recover', str(tmp_path / 'text')]) == 1
    assert not (tmp_path / 'text_recovered').exists()
    assert bag_main(['recover', str(tmp_path / 'nothing')]) == 1
    with pytest.raises(SystemExit, match='2'):
        bag_main(['recover'])


SOUND = {'ended': True, 'exact': True}
GONE = Damage(100, 3100, 'a chunk', messages=5, span_ns=(2 * 10**9, 5 * 10**9))


@pytest.mark.parametrize(
    ('state', 'damages', 'lost', 'column', 'verdict'),
    [
        (SOUND, [], (0, 0), ['0', '0'], 'nothing is lost'),
        (
            SOUND, [GONE], (0, 5), ['0', '5'],
            'lost: 5 messages, within 3.000 s, 3 kB of the input not usable',
        ),
        # Overlapping spans are counted once; what is repeated elsewhere is not lost.
        (
            SOUND,
            [
                GONE,
                Damage(4000, 4500, 'more', messages=1, span_ns=(4 * 10**9, 7 * 10**9)),
                Damage(9000, 9999, 'an index', harmless=True),
            ],
            (2, 4),
            ['2', '4'],
            'lost: 6 messages, within 5.000 s, 3.5 kB of the input not usable',
        ),
        (SOUND, [Damage(1, 3, 'zeros')], (0, 0), ['0', '0'], 'lost: 0 messages, 2 B of'),
        # Without an end, or without statistics, more may be gone than is known.
        (
            {'ended': True}, [GONE], (0, 5), ['?', '>= 5'],
            'lost: >= 5 messages, within 3.000 s, 3 kB of',
        ),
        ({}, [GONE], (0, 5), ['?', '>= 5'], 'lost: >= 5 messages, 3 kB of'),
        (
            {}, [Damage(100, 3100, 'the file has no end')], (0, 0), ['?', '?'],
            'lost: an unknown number of messages, 3 kB of',
        ),
    ],
)  # fmt: skip
def test_recover_says_what_it_knows_of_the_loss(
    state, damages, lost, column, verdict, monkeypatch, tmp_path, capsys
):
    names = '/a', '/b'
    made = [
        FileResult(
            'run_0.mcap', 9000, topics={
                name: TopicResult(name, 'x/Y', kept, unchecked, gone)
                for name, kept, unchecked, gone in zip(
                    names, (40, 300), (7, 0), lost, strict=True
                )
            }, damages=damages, **state,
        ),
        # A sound file of the same bag changes neither the counts nor what is known.
        FileResult('run_1.mcap', 10, True, True, {'/a': TopicResult('/a', 'x/Y', 2)}),
    ]  # fmt: skip
    result = RecoveryResult(tmp_path / 'new', tuple(made))
    monkeypatch.setattr(recovery, 'recover_bag', lambda *_: result)
    assert bag_main(['recover', str(tmp_path / 'x')]) == (0 if verdict == 'nothing is lost' else 3)
    printed = capsys.readouterr().out
    lines = [re.split(r'\s{2,}', line) for line in printed.splitlines()]
    assert lines[:3] == [
        ['topic', 'type', 'kept', 'unchecked', 'lost'],
        ['/a', 'x/Y', '42', '7', column[0]],
        ['/b', 'x/Y', '300', '0', column[1]],
    ]
    said = printed.splitlines()[-1]
    assert said.startswith(f'342 messages are kept in {tmp_path / "new"}; {verdict}')
    assert 'run_1.mcap: sound, copied' in printed
    assert 'no checksum of the file covers these' in printed
    if GONE in damages:
        assert '  bytes 100 to 3100: a chunk; 5 messages lost; within 3.000 s\n' in printed
    assert printed.count('(nothing is lost with it)') == sum(each.harmless for each in damages)


@pytest.mark.parametrize(
    ('size', 'text'),
    [
        (0, '0 B'), (999, '999 B'), (1000, '1 kB'), (12_345, '12.3 kB'), (999_499, '999 kB'),
        (999_501, '1 MB'), (2.5e9, '2.5 GB'), (3.21e12, '3210 GB'),
    ],
)  # fmt: skip
def test_sizes_are_in_a_suitable_unit(size, text):
    assert size_text(int(size)) == text


def test_sqlite_bag_is_rejected_with_advice(tmp_path, capsys):
    (tmp_path / 'bag').mkdir()
    with sqlite3.connect(tmp_path / 'bag' / 'x.db3') as base:
        base.execute('create table topics (id integer)')
    for source in (tmp_path / 'bag', tmp_path / 'bag' / 'x.db3'):
        assert bag_main(['recover', str(source), '--output', str(tmp_path / 'new')]) == 1
        assert 'recovered by sqlite itself' in capsys.readouterr().err
    assert not (tmp_path / 'new').exists()


def test_info_lists_files_topics_parameters_and_incomplete_files(tmp_path, capsys):
    torn = torn_bag(tmp_path / 'run')
    own_bag(tmp_path / 'run')
    assert bag_main(['info', str(tmp_path / 'run')]) == 0
    printed = capsys.readouterr().out
    for words in (
        'UNFINISHED run_0.mcap',
        f'bag recover {tmp_path / "run"}',
        'run_1.mcap',
        '7.990 s',
        'reliable, volatile, keep_last 7',
        'law.gain',
        '2023-11-14 22:13:20 UTC',
    ):
        assert words in printed, words
    cells = [re.split(r'\s{2,}', line) for line in printed.splitlines()]
    (whole,) = {*(tmp_path / 'run').glob('*.mcap')} - {torn}
    size, unfinished = (size_text(file.stat().st_size) for file in (whole, torn))
    assert size != unfinished
    with open_bag(tmp_path / 'run') as bag:
        for topic in bag.topics.values():
            (row,) = (row for row in cells if row[0] == topic.name)
            rate = f'{topic.message_count / 7.99:.2f}'
            assert row[1:4] == [topic.type_name, str(topic.message_count), rate]
    for row in (
        ['messages', '800'],
        ['storage', f'mcap, {size} in 1 file(s)'],
        [f'file {whole.name}', size],
        [f'UNFINISHED {torn.name}', f'{unfinished}, not counted above'],
    ):
        assert row in cells, row
    assert bag_main(['info', str(tmp_path / 'run'), '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['message_count'] == 800
    assert found['metadata_records'] == DETAILS
    counts = {topic['name']: topic['message_count'] for topic in found['topics']}
    assert sum(counts.values()) == 800
    assert found['rates']['/n'] == pytest.approx(counts['/n'] / 7.99)
    assert bag_main(['info', str(torn)]) == 1
    assert 'bag recover' in capsys.readouterr().err
    assert bag_main(['info', str(tmp_path / 'nothing')]) == 1
    (tmp_path / 'text').write_text('hello')
    assert bag_main(['info', str(tmp_path / 'text')]) == 1
    assert 'is no MCAP file' in capsys.readouterr().err


def test_info_reads_files_of_other_writers_and_sqlite_bags(tmp_path, capsys):
    (tmp_path / 'x.mcap').write_bytes(foreign_file())
    assert bag_main(['info', str(tmp_path / 'x.mcap')]) == 0
    assert '120.bin' in capsys.readouterr().out
    store = get_typestore(Stores.ROS2_JAZZY)
    with RosbagsWriter(tmp_path / 'old', version=9) as writer:
        connection = writer.add_connection('/n', NUMBER, typestore=store)
        for i in range(5):
            writer.write(connection, START + i * 10**9, payload(NUMBER, random.Random(i)))
    assert bag_main(['info', str(tmp_path / 'old')]) == 0
    printed = capsys.readouterr().out
    assert 'sqlite3' in printed
    assert '4.000 s' in printed


def test_a_hole_is_unreadable(tmp_path):
    """A hole of 2 GB took a minute and a half and gave an empty bag."""
    path = tmp_path / 'hole.mcap'
    path.write_bytes(MAGIC)
    os.truncate(path, 2**26)
    calls = []
    with pytest.raises(UnreadableError, match='no message that can be read'):
        recover_bag(path, tmp_path / 'out', lambda *call: calls.append(call))
    assert not (tmp_path / 'out').exists()
    assert calls[0] == ('hole.mcap', 8, 2**26)
    assert bag_main(['recover', str(path)]) == 1
