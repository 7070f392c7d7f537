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
from typing import ParamSpec, TypeVar

from t3mpc_ros.missing_library import remedy
from t3mpc_ros.script_error import ScriptError

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
    return str(error) or repr(error)
