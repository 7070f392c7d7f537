# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recovery of a bag: every MCAP file of a folder into a new bag."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
import os
from pathlib import Path
import shutil
from typing import BinaryIO, cast

from t3mpc_ros.bag.mcap_file import MCAP_SUFFIX, read_file_summary
from t3mpc_ros.bag.metadata import MetadataError, collect_metadata, read_metadata, write_metadata
from t3mpc_ros.bag.recovery.recover_file import UnreadableError, recover_file
from t3mpc_ros.bag.recovery.result import Damage, FileResult, RecoveryResult
from t3mpc_ros.bag.schema import BagError

Progress = Callable[[str, int, int], None]
"""Called now and then with a file's name and how many bytes of how many are done."""

_SQLITE = b'SQLite format 3\0'


class RecoveryOutputError(BagError):
    """A folder that recovery must not write into."""


def recover_bag(
    source: Path | str, output: Path | str, progress: Progress | None = None
) -> RecoveryResult:
    """Return what was kept and lost, with everything kept written into the folder ``output``.

    Files that are sound are copied; the others are read record by record and written anew, with
    index and end. Messages keep bytes, order, both times and sequence; channels, schemas,
    attachments and metadata records are kept as well, and ``metadata.yaml`` is made from the
    result. The input is only read.

    Parameters
    ----------
    source
        One MCAP file of any writer, or a folder whose MCAP files are all taken; sub-folders are
        left alone.
    output
        A folder that does not exist, or is empty.

    Raises
    ------
    RecoveryOutputError
        ``output`` is, or lies in, the folder of the bag, or is not empty.
    UnreadableError
        There is no MCAP file, or nothing of one in it.
    OSError
        Reading or writing failed; a file that was begun is removed.
    """
    source, output = Path(source), Path(output)
    files = _files(source)
    _check_output(source, output)
    _reject_sqlite(files)
    made = not output.exists()
    output.mkdir(parents=True, exist_ok=True)
    tell = progress or (lambda name, done, size: None)
    outcomes = []
    for path in files:
        try:
            outcomes.append(_recover_file(path, output / _target_name(path), tell))
        except UnreadableError as error:
            if len(files) == 1:
                if made:
                    output.rmdir()
                raise
            size = path.stat().st_size
            nothing = Damage(0, size, str(error))
            outcomes.append(FileResult(path.name, size, damages=[nothing]))
    metadata, _ = collect_metadata(output)
    try:
        earlier = read_metadata(files[0].parent)
    except MetadataError:
        pass  # most often there is none; then the defaults stand
    else:
        metadata = replace(
            metadata, custom_data=earlier.custom_data, ros_distro=earlier.ros_distro
        )
    write_metadata(output, metadata)
    return RecoveryResult(output, tuple(outcomes))


def default_output(source: Path | str) -> Path:
    """Return the folder for a recovery when none is given: beside the input, under its name."""
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
        f'{path} is an sqlite3 bag: sqlite3 bags are recovered by sqlite itself, whenever they '
        'are opened; when that fails, `sqlite3 FILE.db3 .recover | sqlite3 NEW.db3`, then '
        '`ros2 bag reindex FOLDER`'
    )


def _check_output(source: Path, output: Path) -> None:
    folder = (source if source.is_dir() else source.parent).resolve()
    target = output.resolve()
    if target == folder:
        raise RecoveryOutputError(f'{output} is the folder of the input: choose another one')
    if source.is_dir() and target.is_relative_to(folder):
        raise RecoveryOutputError(f'{output} lies in the bag {source}: choose a folder elsewhere')
    if output.exists() and not output.is_dir():
        raise RecoveryOutputError(f'{output} is a file: choose a new folder')
    if output.is_dir() and any(output.iterdir()):
        raise RecoveryOutputError(f'{output} is not empty: choose a new folder')


def _target_name(path: Path) -> str:
    return path.name if path.suffix == MCAP_SUFFIX else f'{path.name}{MCAP_SUFFIX}'


def _recover_file(path: Path, target: Path, progress: Progress) -> FileResult:
    def tell(done: int, size: int) -> None:
        progress(path.name, done, size)

    with path.open('rb') as source:
        if read_file_summary(path) is not None:
            # Its end is sound; whether its chunks are, only reading them tells.
            outcome = recover_file(
                source, cast(BinaryIO, _NullOutput()), path.name, tell, compress=False
            )
            if outcome.clean and not outcome.damages and not outcome.notes:
                outcome.copied = True
                source.seek(0)
                with _new_file(target) as output:
                    shutil.copyfileobj(source, output)
                return outcome
        with _new_file(target) as output:
            return recover_file(source, output, path.name, tell)


@contextmanager
def _new_file(path: Path) -> Iterator[BinaryIO]:
    """Open a new file for writing; remove it when the writing does not get to its end."""
    with path.open('xb') as output:
        try:
            yield output
            output.flush()
            os.fsync(output.fileno())
        except BaseException:
            path.unlink(missing_ok=True)
            raise


class _NullOutput:
    """An output that only knows how much was written to it."""

    def __init__(self) -> None:
        self._size = 0

    def write(self, data: bytes) -> int:
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """Nothing is held back."""
