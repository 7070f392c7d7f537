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
"""Type-3 fuzzy, Boltzmann-machine predictive control along chaotic references.

The names of :data:`__all__` are the scripting interface, ``import t3mpc_ros as t3``. Each is
imported from :mod:`t3mpc_ros.evaluation.api` when it is first used: the import of the package
alone imports no library and compiles nothing.
"""

from importlib import import_module
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from t3mpc_ros.version import VERSION

if TYPE_CHECKING:
    from t3mpc_ros.evaluation.api.bag_columns import BagColumns, read_bag
    from t3mpc_ros.evaluation.api.chaos_generator import ChaosSolution, chaos
    from t3mpc_ros.evaluation.api.comparison_runs import Comparison, compare
    from t3mpc_ros.evaluation.api.fuzzy_system import FuzzySystem, fuzzy
    from t3mpc_ros.evaluation.api.own_reference import Waypoints
    from t3mpc_ros.evaluation.api.own_robot import NoiseLaw, OdePlant, Robot, StateSpace
    from t3mpc_ros.evaluation.api.parameter_sweep import Sweep, sweep
    from t3mpc_ros.evaluation.api.script_inputs import Controller
    from t3mpc_ros.evaluation.api.single_run import RunResult, simulate
    from t3mpc_ros.evaluation.baselines.baseline_controller import NominalModel, Observation
    from t3mpc_ros.evaluation.cases import LinkFaults
    from t3mpc_ros.script_error import ScriptError
    from t3mpc_ros.simulation.fault_schedule import FaultEvent, FaultSchedule

__version__ = VERSION
__all__ = [
    'BagColumns',
    'ChaosSolution',
    'Comparison',
    'Controller',
    'FaultEvent',
    'FaultSchedule',
    'FuzzySystem',
    'LinkFaults',
    'NoiseLaw',
    'NominalModel',
    'Observation',
    'OdePlant',
    'Robot',
    'RunResult',
    'ScriptError',
    'StateSpace',
    'Sweep',
    'Waypoints',
    'chaos',
    'compare',
    'fuzzy',
    'read_bag',
    'simulate',
    'sweep',
]

_BASELINE = 'evaluation.baselines.baseline_controller'
_HOMES = {
    'evaluation.api.bag_columns': ('BagColumns', 'read_bag'),
    'evaluation.api.chaos_generator': ('ChaosSolution', 'chaos'),
    'evaluation.api.comparison_runs': ('Comparison', 'compare'),
    'evaluation.api.fuzzy_system': ('FuzzySystem', 'fuzzy'),
    'evaluation.api.own_reference': ('Waypoints',),
    'evaluation.api.own_robot': ('NoiseLaw', 'OdePlant', 'Robot', 'StateSpace'),
    'evaluation.api.parameter_sweep': ('Sweep', 'sweep'),
    'evaluation.api.script_inputs': ('Controller',),
    'script_error': ('ScriptError',),
    'evaluation.api.single_run': ('RunResult', 'simulate'),
    'evaluation.cases': ('LinkFaults',),
    'simulation.fault_schedule': ('FaultEvent', 'FaultSchedule'),
    _BASELINE: ('NominalModel', 'Observation'),
}
_MODULE = {name: module for module, names in _HOMES.items() for name in names}
_CALLABLE = ('chaos', 'fuzzy')
"""Packages that are functions of the interface, too."""


def _public(name: str) -> Any:
    return getattr(import_module(f'{__name__}.{_MODULE[name]}'), name)


class _CallablePackage(ModuleType):
    """A package that can be called as the function of its name."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return self._function(*arguments, **options)

    @property
    def _function(self) -> Any:
        return _public(self.__name__.rpartition('.')[2])

    @property
    def __signature__(self) -> Any:
        from inspect import signature

        return signature(self._function)


class _Package(ModuleType):
    """The package itself: an import that binds one of its callable packages makes it callable."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _CALLABLE and type(value) is ModuleType:
            value.__class__ = _CallablePackage
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name in _CALLABLE:
        return import_module(f'{__name__}.{name}')
    if name not in _MODULE:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = _public(name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
