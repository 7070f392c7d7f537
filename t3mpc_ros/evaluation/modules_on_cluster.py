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
"""Modules of a user's own on the workers of a cluster.

A controller that imports a module beside it works in the processes of this machine, which have
the folder on their path; the workers, and the scheduler, of a cluster have neither file nor
folder. They get the text of the module with the job, and of another text at the next one.
"""

from concurrent.futures import Executor, Future
from importlib.abc import InspectLoader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
import pickle
import sys
from threading import RLock
from types import ModuleType
from typing import Any, NamedTuple

from t3mpc_ros.evaluation.run_cache_key import is_own, own_text, source_digest
from t3mpc_ros.script_error import ScriptError


class SourceText(NamedTuple):
    """A module as it is sent."""

    path: str
    text: str
    package: bool


Sources = dict[str, SourceText]


def own_sources() -> Sources:
    """Return the loaded modules of one's own that have a file, by their names."""
    found: Sources = {}
    for name, module in list(sys.modules.items()):
        if getattr(module, '__file__', None) and is_own(name) and (text := own_text(module)):
            found[name] = SourceText(str(module.__file__), text, hasattr(module, '__path__'))
    for name in list(found):  # folders without __init__.py
        parts = name.split('.')[:-1]
        for count in range(1, len(parts) + 1):
            found.setdefault('.'.join(parts[:count]), SourceText('', '', True))
    return found


class ModuleCarrier(Executor):
    """The executor of a cluster, whose workers get the modules of one's own with each job."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self._sources, self._package = own_sources(), source_digest()

    def submit(self, task: Any, /, *arguments: Any, **options: Any) -> Future[Any]:
        """Return the future of ``task`` on a worker."""
        from cloudpickle import dumps

        # As bytes: the scheduler unpickles everything else, and has no such module.
        job = dumps((task, arguments, options))
        return self._executor.submit(run_carried, self._package, self._sources, job)


def run_carried(package: str, sources: Sources, job: bytes) -> Any:
    """Return what a job returns, after its modules were made known in this process.

    ``package`` is the digest of the sources of this package: others give other numbers.
    """
    if source_digest() != package:
        raise ScriptError(
            'a worker of the cluster has another t3mpc_ros than the process that sends the runs: '
            'install the same version in both'
        )
    FINDER.provide(sources)
    try:
        task, arguments, options = pickle.loads(job)
    except ImportError as error:
        raise ScriptError(
            f'a worker of the cluster lacks the module {error.name}: install it there'
        ) from None
    except Exception as error:
        raise ScriptError(f'a worker of the cluster cannot load the run: {error!r}') from None
    return task(*arguments, **options)


class _Finder(MetaPathFinder, InspectLoader):
    """Finds the modules that jobs brought."""

    def __init__(self) -> None:
        self._given: Sources = {}
        self._sources: Sources = {}
        """Those that are not loaded from files of this machine."""
        self._lock = RLock()

    def provide(self, sources: Sources) -> None:
        """Make modules known; those that are loaded with another text are forgotten."""
        with self._lock:
            if sources == self._given:
                return
            # Of a worker that is a thread of the program, the modules are loaded already.
            others = {name for name, source in sources.items() if not _is_loaded(name, source)}
            brought = {name for name in self._sources if _loader(name) is self}
            if any(name in sys.modules for name in others):
                others |= brought  # they may hold parts of a module of the old text
            self._given = sources
            self._sources = {
                name: source for name, source in sources.items() if name in others | brought
            }
            for name in others:
                sys.modules.pop(name, None)
            if self._sources and self not in sys.meta_path:
                sys.meta_path.insert(0, self)

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the specification of a module that was brought."""
        source = self._sources.get(fullname)
        if source is None:
            return None
        return spec_from_loader(fullname, self, origin=source.path, is_package=source.package)

    def get_source(self, fullname: str) -> str:
        """Return the text of a module."""
        return self._sources[fullname].text

    def exec_module(self, module: ModuleType) -> None:
        """Run a module, with the path that it has on the machine that sent it."""
        source = self._sources[module.__name__]
        module.__file__ = source.path
        exec(compile(source.text, source.path, 'exec'), vars(module))


FINDER = _Finder()


def _loader(name: str) -> Any:
    return getattr(getattr(sys.modules.get(name), '__spec__', None), 'loader', None)


def _is_loaded(name: str, source: SourceText) -> bool:
    """Return whether a module is loaded with this text, as where a worker is a thread."""
    if name not in sys.modules:
        return False
    loader = _loader(name)
    try:
        return loader is None or loader.get_source(name) == source.text
    except (AttributeError, ImportError, KeyError):
        # A folder without __init__.py, or a loader that keeps no text, as that of pytest.
        return own_text(sys.modules[name]) == source.text
