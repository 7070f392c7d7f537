# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recovery of a bag: all MCAP files of a folder, or a single one, into a new bag."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
import os
from pathlib import Path
import shutil
from typing import BinaryIO, cast

from t3mpc_ros.bag.mcap_file import MCAP_SUFFIX, collect_metadata, read_mcap_file
from t3mpc_ros.bag.metadata import read_origin, sync_folder, write_metadata
from t3mpc_ros.bag.recovery.recover_file import UnreadableError, recover_file
from t3mpc_ros.bag.recovery.result import Damage, FileResult, RecoveryResult
from t3mpc_ros.bag.schema import BagError

Progress = Callable[[str, int, int], None]
"""Callback with the name of a file, the number of processed bytes and its size."""

_SQLITE = b'SQLite format 3\0'


class RecoveryOutputError(BagError):
    """The output folder is not permitted."""


def recover_bag(
    source: Path | str, output: Path | str, progress: Progress | None = None
) -> RecoveryResult:
    """Recover a bag into the folder ``output``; return the kept and lost messages.

    Intact files are copied after a verification of their checksums. Damaged files are rewritten
    record by record, with a summary section. Messages keep their bytes, order, stamps and
    sequence numbers; channels, schemas, attachments and metadata records are kept as well, and
    ``metadata.yaml`` is generated. The input is not changed.

    Parameters
    ----------
    source
        An MCAP file of any writer, or a folder of MCAP files; sub-folders are ignored.
    output
        A folder that is empty or does not exist.

    Raises
    ------
    RecoveryOutputError
        ``output`` is, or is in, the folder of the bag, or is not empty.
    UnreadableError
        There is no MCAP file, or the only one contains no MCAP data.
    OSError
        Reading or writing failed; an incomplete output file is removed.
    """
    source, output = Path(source), Path(output)
    files = _files(source)
    _check_output(source, output)
    _reject_sqlite(files)
    created = not output.exists()
    output.mkdir(parents=True, exist_ok=True)
    report = progress or (lambda name, done, size: None)
    results = []
    for path in files:
        try:
            results.append(_recover_file(path, output / _target_name(path), report))
        except UnreadableError as error:
            if len(files) == 1:
                if created:
                    output.rmdir()
                raise
            size = path.stat().st_size
            entire_file = Damage(0, size, str(error))
            results.append(FileResult(path.name, size, damages=[entire_file]))
    metadata, _ = collect_metadata(output)
    if (origin := read_origin(files[0].parent)) is not None:  # usually missing
        metadata = replace(metadata, custom_data=origin[0], ros_distro=origin[1])
    write_metadata(output, metadata)
    sync_folder(output.parent)
    return RecoveryResult(output, tuple(results))


def default_output(source: Path | str) -> Path:
    """Return the default output folder: beside the input, with the suffix ``_recovered``."""
    source = Path(source).absolute()
    stem = source.name if source.is_dir() else source.name.removesuffix(MCAP_SUFFIX)
    return source.with_name(f'{stem}_recovered')


def _files(source: Path) -> list[Path]:
    if source.is_dir():
        files = sorted(path for path in source.glob(f'*{MCAP_SUFFIX}') if path.is_file())
        if not files:
            if list(source.glob('*.db3')):
                raise UnreadableError(_sqlite_advice(source))
            raise UnreadableError(f'there is no MCAP file in {source}')
        return files
    if not source.is_file():
        raise UnreadableError(f'{source} is neither a file nor a folder')
    return [source]


def _reject_sqlite(files: list[Path]) -> None:
    for path in files:
        with path.open('rb') as file:
            if file.read(len(_SQLITE)) == _SQLITE:
                raise UnreadableError(_sqlite_advice(path))


def _sqlite_advice(path: Path) -> str:
    return (
        f'{path} is an sqlite3 bag: sqlite3 bags are recovered by sqlite itself when they are '
        'opened; if that fails, run `sqlite3 FILE.db3 .recover | sqlite3 NEW.db3`, then '
        '`ros2 bag reindex FOLDER`'
    )


def _check_output(source: Path, output: Path) -> None:
    folder = (source if source.is_dir() else source.parent).resolve()
    target = output.resolve()
    if target == folder:
        raise RecoveryOutputError(f'{output} is the folder of the input: choose another one')
    if source.is_dir() and target.is_relative_to(folder):
        raise RecoveryOutputError(f'{output} is inside the bag {source}: choose another folder')
    if output.exists() and not output.is_dir():
        raise RecoveryOutputError(f'{output} is a file: choose a new folder')
    if output.is_dir() and any(output.iterdir()):
        raise RecoveryOutputError(f'{output} is not empty: choose a new folder')


def _target_name(path: Path) -> str:
    return path.name if path.suffix == MCAP_SUFFIX else f'{path.name}{MCAP_SUFFIX}'


def _recover_file(path: Path, target: Path, progress: Progress) -> FileResult:
    def report(done: int, size: int) -> None:
        progress(path.name, done, size)

    with path.open('rb') as source:
        if read_mcap_file(path) is not None:
            # The summary is valid; the chunks are verified by a recovery without output.
            result = recover_file(
                source, cast(BinaryIO, _NullOutput()), path.name, report, compress=False
            )
            if result.clean and not result.damages and not result.notes:
                result.copied = True
                source.seek(0)
                with _new_file(target) as output:
                    shutil.copyfileobj(source, output)
                return result
        with _new_file(target) as output:
            result = recover_file(source, output, path.name, report)
            if not result.ended and not result.topics:
                # An empty bag would look like a recovery.
                raise UnreadableError(f'{path.name} contains no message that can be read')
            return result


@contextmanager
def _new_file(path: Path) -> Iterator[BinaryIO]:
    """Open a new file for writing; remove it if writing fails."""
    with path.open('xb') as output:
        try:
            yield output
            output.flush()
            os.fsync(output.fileno())
        except BaseException:
            path.unlink(missing_ok=True)
            raise


class _NullOutput:
    """Output that discards the data and counts the bytes."""

    def __init__(self) -> None:
        self._size = 0

    def write(self, data: bytes) -> int:
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """Do nothing."""
