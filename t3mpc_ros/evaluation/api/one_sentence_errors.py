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
"""What makes an error of the scripting interface one sentence."""

from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from functools import wraps
from pathlib import Path
import traceback
from typing import ParamSpec, TypeVar

from t3mpc_ros.atomic_file import NO_ROOM
from t3mpc_ros.missing_library import remedy
from t3mpc_ros.script_error import ScriptError
from t3mpc_ros.version import PACKAGE_DIRECTORY

P = ParamSpec('P')
R = TypeVar('R')


def one_sentence(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function with its errors as :class:`ScriptError`, of one sentence each."""

    @wraps(function)
    def public(*arguments: P.args, **options: P.kwargs) -> R:
        try:
            return function(*arguments, **options)
        except ModuleNotFoundError as error:
            if not (text := remedy(error)):
                raise
        except (ValueError, OSError, RuntimeError, ArithmeticError) as error:
            text = sentence(error)
        raise ScriptError(text)

    return public


def sentence(error: BaseException) -> str:
    """Return what went wrong in one sentence: the text of the error, or that of its origin."""
    cause = error.__cause__
    if isinstance(cause, BrokenExecutor) or isinstance(error, BrokenExecutor):
        from t3mpc_ros.evaluation.experiment import LOST_PROCESS

        return LOST_PROCESS
    if isinstance(cause, ScriptError):
        return str(cause)
    if isinstance(error, OSError) and error.errno in NO_ROOM:
        return (
            f'{error.filename or "the output"} cannot be written: {error.strerror}; free space '
            'there, raise the quota or the limit of file sizes, or write to another disk'
        )
    return str(error) or repr(error)


def described(error: BaseException, file: str = '') -> str:
    """Return an error with its place: the last line of one's own code, in one sentence."""
    if isinstance(error, SyntaxError):
        return f'SyntaxError in line {error.lineno}: {error.msg}'
    frames = traceback.extract_tb(error.__traceback__)
    package = str(PACKAGE_DIRECTORY)
    own = [
        frame
        for frame in frames
        if not str(Path(frame.filename).resolve()).startswith(package)
        and 'site-packages' not in frame.filename
        and (not file or frame.filename == file)
    ]
    text = f'{type(error).__name__} ({error})' if str(error) else type(error).__name__
    if own:
        text += f' in {own[-1].name}(), {Path(own[-1].filename).name} line {own[-1].lineno}'
    return text
