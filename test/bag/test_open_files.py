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
"""Files of bags, models and keys: closed in every case, and on the disk where it matters."""

import ast
from contextlib import suppress
import errno
import itertools
import os
from pathlib import Path
import pty
import sys
import threading
import time

from mcap.records import Attachment
import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from support.bag_messages import STORE
from support.file_watch import Disk, no_file_left_open

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.bag import writer as writer_module
from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.bag.mcap_file import has_mcap_magic, read_mcap_file
from t3mpc_ros.bag.message_definitions import MessageDefinitions
from t3mpc_ros.bag.metadata_yaml import BagMetadata, read_origin, write_metadata
from t3mpc_ros.bag.player import MergedReader, PlaybackParameters, PlaybackTimeline, ReadAheadQueue
from t3mpc_ros.bag.qos import QosError, read_qos_overrides
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.recovery import recover_bag
from t3mpc_ros.bag.writer import SYNC_PERIOD_NS, BagWriter, read_attachment
from t3mpc_ros.evaluation.experiment import ResultFile
from t3mpc_ros.model_file import ModelError, load_model, save_model
from t3mpc_ros.radio.protocol.authentication import read_key
from t3mpc_ros.radio.serial_port import PortError, SerialPort
from t3mpc_ros.radio.tool.key_provisioning import create_key_file
from t3mpc_ros.view import server
from t3mpc_ros.view.live_data import LiveData

NUMBER = 'std_msgs/msg/Float64'
START = 1_700_000_000 * 10**9
DATA = b'\0\1\0\0' + bytes(8)
DEFINITIONS = MessageDefinitions()
REFUSED = BagError, ModelError, PortError, QosError, OSError, ValueError


def mcap_bag(folder, topic='/a', count=20, close=True, type_name=NUMBER):
    made = BagWriter(folder, metadata_records={}, chunk_bytes=100, definitions=DEFINITIONS)
    made.add_topic(topic, type_name)
    made.add_attachment(Attachment(0, START, 'a', 'text/plain', b'text'))
    for number in range(count):
        made.write(topic, START + number * 10**7, START, DATA)
    if close:
        made.close()
    return made


def sqlite_bag(folder, topic='/a', type_name=NUMBER, count=200):
    with RosbagsWriter(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as made:
        connection = made.add_connection(topic, type_name, typestore=STORE)
        for number in range(count):
            made.write(connection, START + number * 10**7, DATA)
    return folder


def damage(path, position=-200):
    content = bytearray(path.read_bytes())
    content[position:] = bytes(len(content[position:]))
    path.write_bytes(content)


# -- bags -----------------------------------------------------------------------------------------


def read_everything(folder):
    for make in (lambda path: mcap_bag(path), sqlite_bag):
        path = folder / make.__name__.strip('<>')
        make(path)
        with open_bag(path) as bag:
            assert len([*bag.serialized_messages()]) == bag.message_count
            bag.series('/a', {'x': 'data'})
            bag.attachments()
            stream = bag.serialized_messages()
            next(stream)
        stream.close()


def bags_of_two_files(folder):
    sqlite_bag(folder / 'a').joinpath('a.db3').rename(folder / 'a' / '0.db3')
    (folder / 'a' / 'metadata.yaml').unlink()
    (folder / 'a' / '1.db3').write_bytes(b'no database' * 100)
    open_bag(folder / 'a')


def a_bag_of_no_known_format(folder):
    for name, content in {
        'a.bag': b'#ROSBAG V2.0\n',
        'b.db3': b'x' * 999,
        'c': b'',
        'd': b'x',
    }.items():
        (folder / name).write_bytes(content)
        with suppress(*REFUSED):
            open_bag(folder / name)
    open_bag(folder / 'nothing')


def a_damaged_bag(folder):
    made = mcap_bag(folder / 'a')
    content = bytearray(made.path.read_bytes())
    content[600:640] = bytes(40)
    made.path.write_bytes(content)
    with open_bag(folder / 'a') as bag:
        with suppress(*REFUSED):
            bag.attachments()
        [*bag.serialized_messages()]


def played_bags_with_two_types(folder):
    sqlite_bag(folder / 'a')
    sqlite_bag(folder / 'b', type_name='std_msgs/msg/Int64')
    PlaybackParameters(uris=(f'{folder / "a"}', f'{folder / "b"}')).open_reader()


def played_bags_without_the_second(folder):
    sqlite_bag(folder / 'a')
    PlaybackParameters(uris=(f'{folder / "a"}', f'{folder / "b"}')).open_reader()


def a_player_that_is_closed(folder):
    readers = MergedReader([open_bag(sqlite_bag(folder / 'a'))])
    mcap_bag(folder / 'b', count=600)
    readers = [readers, MergedReader([open_bag(folder / 'b')])]
    for reader in readers:
        begin_ns, end_ns = reader.start_ns, reader.end_ns
        timeline = PlaybackTimeline(
            lambda at_ns, reader=reader, span=(begin_ns, end_ns): ReadAheadQueue(
                reader.schedule(at_ns, *span, True), 100
            ),
            begin_ns,
            end_ns,
            loop=True,
        )
        timeline.due_messages(0)
        assert timeline.seek(0, end_ns) == ''
        timeline.due_messages(0)
        timeline.close()
        reader.close()


def fails(number):
    """Return a function that raises from its nth call on that the disk is full."""
    calls, write = itertools.count(1), writer_module._Output.write

    def call(output, data):
        if next(calls) >= number:
            raise OSError(errno.ENOSPC, 'No space left on device')
        return write(output, data)

    return call


def a_writer_on_a_full_disk(folder):
    for number in range(1, 12):
        with pytest.MonkeyPatch.context() as patch, suppress(*REFUSED):
            patch.setattr(writer_module._Output, 'write', fails(number))
            made = mcap_bag(folder / f'{number}')
            made.split()
            made.write('/a', START, START, DATA)
            made.close()


def a_writer_without_folder(folder):
    (folder / 'file').touch()
    BagWriter(folder / 'file', metadata_records={})


def a_recovery(folder):
    for name, position in {'cut': -300, 'chunk': -900}.items():
        damage(mcap_bag(folder / name).path, position)
        recover_bag(folder / name, folder / f'{name}_recovered')
    recover_bag(mcap_bag(folder / 'whole').folder, folder / 'copied')


def a_recovery_on_a_full_disk(folder):
    damage(mcap_bag(folder / 'a').path)

    def full(file):
        raise OSError(errno.ENOSPC, 'No space left on device')

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, 'fsync', full)
        with suppress(OSError):
            write_metadata(folder, BagMetadata())
        recover_bag(folder / 'a', folder / 'b')


def a_recovery_of_nothing(folder):
    (folder / 'a.mcap').write_bytes(b'x' * 1000)
    assert read_mcap_file(folder / 'a.mcap') is None
    assert not has_mcap_magic(folder / 'a.mcap')
    recover_bag(folder / 'a.mcap', folder / 'b')


def an_attachment_that_is_too_large(folder):
    (folder / 'a').write_bytes(bytes(100))
    read_attachment(folder / 'a', 10, START)


# -- other files ----------------------------------------------------------------------------------


def texts(folder):
    (folder / 'metadata.yaml').write_bytes(b'\xff: [')
    read_origin(folder)
    open_bag_of_text = folder / 'metadata.yaml'
    with suppress(*REFUSED):
        open_bag(open_bag_of_text)
    MessageDefinitions().schema(NUMBER)
    MessageDefinitions().type_hash(NUMBER)
    read_qos_overrides(f'{folder / "metadata.yaml"}')


def models(folder):
    save_model(folder / 'a.npz', {}, {})
    load_model(folder / 'a.npz')
    for content in (b'', b'PK\x03\x04 no archive', b'\x93NUMPY no array'):
        (folder / 'b.npz').write_bytes(content)
        with suppress(*REFUSED):
            load_model(folder / 'b.npz')
    (folder / 'a').mkdir()
    save_model(folder / 'a', {}, {})


def keys(folder):
    create_key_file(folder / 'key', lambda count: bytes(range(1, count + 1)))
    assert read_key(folder / 'key') == bytes(range(1, 17))
    os.mkfifo(folder / 'fifo', 0o600)
    for name, content in {'short': 'ab', 'words': 'no key', 'zeros': '0' * 32}.items():
        (folder / name).write_text(content)
        (folder / name).chmod(0o600)
    for name in ('fifo', 'short', 'words', 'zeros', 'missing'):
        with suppress(ValueError):
            read_key(folder / name)
    create_key_file(folder / 'key', os.urandom)


def a_serial_port(folder):
    main, other = pty.openpty()
    path = os.ttyname(other)
    try:
        SerialPort(path).close()
        for use in (lambda port: port.read(), lambda port: port.write(b'x')):
            port = SerialPort(path)
            os.close(os.dup(port.fileno()))
            with pytest.MonkeyPatch.context() as patch, suppress(*REFUSED):
                patch.setattr(port._serial, 'read', _unplugged)
                patch.setattr(port._serial, 'write', _unplugged)
                use(port)
        with suppress(*REFUSED):
            SerialPort(f'{folder / "missing"}')
    finally:
        os.close(main)
        os.close(other)
    (folder / 'file').touch()
    SerialPort(f'{folder / "file"}')


def _unplugged(*_):
    raise OSError(errno.EIO, 'Input/output error')


def a_page(folder):
    server._file.__wrapped__('view.html')
    server._text_of(Path(__file__))
    with server.PageServer(LiveData(), None, 0, time.monotonic) as page, suppress(OSError):
        server.PageServer(LiveData(), None, page.port, time.monotonic)


def results(folder):
    file = ResultFile(folder / 'a.jsonl')
    other = ResultFile(folder / 'a.jsonl')
    with file:
        file.add('a', {'b': 1})
        with suppress(RuntimeError), other:
            pass
    with suppress(OSError):
        write_atomically(Path('/proc/nothing/file'), 'text')
    write_atomically(folder / 'b', 'text')


SCENARIOS = (
    read_everything, bags_of_two_files, a_bag_of_no_known_format, a_damaged_bag,
    played_bags_with_two_types, played_bags_without_the_second, a_player_that_is_closed,
    a_writer_on_a_full_disk, a_writer_without_folder, a_recovery,
    a_recovery_on_a_full_disk, a_recovery_of_nothing, an_attachment_that_is_too_large, texts,
    models, keys, a_serial_port, a_page, results,
)  # fmt: skip
"""Each opens files and ends in any way, mostly with an error."""


OPENING = {
    'open', 'fdopen', 'pipe', 'atomic_file', 'load', 'read_text', 'read_bytes', 'Serial',
    'AnyReader', '_Server', '_Output',
}  # fmt: skip


@pytest.mark.slow
def test_every_file_is_closed(tmp_path):
    """Every function in which a file is opened is called in a scenario."""
    called = set()

    def note(frame, event, argument):
        called.add((frame.f_code.co_filename, frame.f_code.co_name))

    for scenario in SCENARIOS:
        folder = tmp_path / scenario.__name__
        folder.mkdir()
        threading.setprofile(note)
        sys.setprofile(note)
        try:
            with no_file_left_open(), suppress(*REFUSED):
                scenario(folder)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    root = Path(writer_module.__file__).parents[1]
    paths = [path for name in ('radio', 'bag', 'view') for path in (root / name).rglob('*.py')]
    opening = {
        (f'{path}', function.name)
        for path in paths
        for function in ast.walk(ast.parse(path.read_text()))
        if isinstance(function, ast.FunctionDef) and _opens(function)
    }
    assert len(opening) > 20
    assert opening - called == set()


def _opens(function):
    calls = [each.func for each in ast.walk(function) if isinstance(each, ast.Call)]
    names = {getattr(each, 'attr', getattr(each, 'id', '')) for each in calls}
    return bool(names & OPENING)


# -- power failure --------------------------------------------------------------------------------


def a_closed_bag(folder):
    made = mcap_bag(folder / 'new' / 'bag')
    return made.folder, made.path, made.folder / 'metadata.yaml'


def a_split_bag(folder):
    made = mcap_bag(folder / 'bag', close=False)
    before = made.path
    made.split()
    names = before, made.folder / 'metadata.yaml'
    return names if made.close() is None else ()


def a_bag_after_the_period(folder):
    made = mcap_bag(folder / 'bag', close=False)
    made.flush()
    made.tick(2 * SYNC_PERIOD_NS)
    assert made.size == made.path.stat().st_size
    try:
        return made.folder, made.path
    finally:
        made._output.abandon()


def a_bag_of_a_full_disk(folder):
    with pytest.MonkeyPatch.context() as patch, suppress(*REFUSED):
        patch.setattr(writer_module._Output, 'free', lambda output: 70_000 - output.size)
        mcap_bag(folder / 'bag', count=100)
    assert (folder / 'bag' / 'metadata.yaml').read_text().count('path: ') == 1
    return folder / 'bag' / 'bag_0.mcap', folder / 'bag' / 'metadata.yaml'


def a_recovered_bag(folder):
    damage(mcap_bag(folder / 'a').path)
    recover_bag(folder / 'a', folder / 'b')
    return folder / 'b', *(folder / 'b').iterdir()


def a_copied_bag(folder):
    recover_bag(mcap_bag(folder / 'a').folder, folder / 'b')
    return folder / 'b', *(folder / 'b').iterdir()


def a_model(folder):
    save_model(folder / 'a.npz', {}, {})
    save_model(folder / 'a.npz', {}, {'b': 1})
    return (folder / 'a.npz',)


DURABLE = (
    a_closed_bag, a_split_bag, a_bag_after_the_period, a_bag_of_a_full_disk, a_recovered_bag,
    a_copied_bag, a_model,
)  # fmt: skip


@pytest.mark.parametrize('scenario', DURABLE, ids=lambda each: each.__name__)
def test_what_is_written_survives_a_power_failure(scenario, tmp_path, monkeypatch):
    disk = Disk(monkeypatch)
    paths = scenario(tmp_path)
    assert paths
    assert [path for path in paths if not disk.has(path)] == []


def test_a_key_and_replaced_text_are_on_the_disk(tmp_path, monkeypatch):
    disk = Disk(monkeypatch)
    create_key_file(tmp_path / 'key', os.urandom)
    write_atomically(tmp_path / 'text', 'new')
    assert all(map(disk.has_content, tmp_path.iterdir()))


def test_a_model_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    save_model(tmp_path / 'a.npz', {}, {'gain': 1})
    before = (tmp_path / 'a.npz').read_bytes()
    monkeypatch.setattr('numpy.savez_compressed', lambda file, **_: fails(1)(file, b''))
    with pytest.raises(RuntimeError, match='cannot write the model file .*: No space left'):
        save_model(tmp_path / 'a.npz', {}, {'gain': 2})
    assert [path.name for path in tmp_path.iterdir()] == ['a.npz']
    assert (tmp_path / 'a.npz').read_bytes() == before
