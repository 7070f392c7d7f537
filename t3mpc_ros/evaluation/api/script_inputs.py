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
"""What a script gives: its controllers, and the scenario of its runs.

A controller is a class or function of one's own, or a method of the package by name; a scenario
has a robot, a reference, noise and faults.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import partial
import hashlib
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec
import inspect
from pathlib import Path
import pickle
import sys
from threading import RLock
from types import ModuleType
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from t3mpc_ros.evaluation.api.one_sentence_errors import described, one_sentence
from t3mpc_ros.evaluation.api.own_reference import sampled
from t3mpc_ros.evaluation.api.own_robot import (
    NoiseLaw,
    OdePlant,
    Robot,
    StateSpace,
    gaussian_noise,
)
from t3mpc_ros.evaluation.baselines.baseline_controller import (
    BaselineController,
    NominalModel,
    Observation,
)
from t3mpc_ros.evaluation.cases import NOMINAL, ROBOTS, LinkFaults
from t3mpc_ros.evaluation.loop import ComparedMethod, MethodDriver, MethodSpec, NodeMethod
from t3mpc_ros.evaluation.method_table import methods_for, require_libraries
from t3mpc_ros.evaluation.scenario import KINDS, OwnParts, Scenario
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import Array, read_only
from t3mpc_ros.parameters.table import Parameters, find_names
from t3mpc_ros.script_error import ScriptError
from t3mpc_ros.simulation.fault_schedule import FaultEvent, FaultSchedule, load_schedule

Settings = Mapping[str, Any]
FILE_SEPARATOR = '.py:'
MODEL = 'model'
"""Name of the argument of a class that gets the :class:`NominalModel`."""
_CLASS_DATA: WeakKeyDictionary[type, dict[str, tuple[object, bytes]]] = WeakKeyDictionary()
"""Objects that the classes of controllers hold, and what was in them when a run began."""
_RUNNING_A_FILE = RLock()
"""A worker of a cluster has several threads, which begin with the same file."""


@dataclass(frozen=True)
class Controller:
    """A controller with a name in the tables, and with values other than its defaults.

    Parameters
    ----------
    source
        The name of a method of the package, such as ``'full'`` or ``'PI + feed-forward'``;
        ``'file.py:Name'``; a class with a method ``step``; an object of one; or a function. A
        run makes its own controller: an object is copied. ``step``, or the function, gets an
        :class:`Observation` once in each control period and returns the accelerations of the right
        and the left wheel, rad/s², a numpy array of shape (2,). A class with an argument
        ``model`` gets the :class:`NominalModel`.
    settings
        Parameters of a method by name, or keyword arguments of a class or a function.
    name
        In tables and errors; by default that of the source, with the settings.
    """

    source: Any
    settings: Settings = field(default_factory=dict)
    name: str = ''

    @one_sentence
    def __post_init__(self) -> None:
        if not isinstance(self.settings, Mapping):
            raise ScriptError(
                f'settings must be a mapping of names to values: got {self.settings!r}'
            )
        if not self.name:
            values = ', '.join(f'{name} {value}' for name, value in self.settings.items())
            plain = _plain_name(self.source)
            object.__setattr__(self, 'name', f'{plain}, {values}' if values else plain)

    def method(self, robot: str) -> ComparedMethod:
        """Return it as a method of a robot: ``twin``, ``servo`` or ``torque``."""
        if isinstance(self.source, str) and FILE_SEPARATOR not in self.source:
            return self._packaged(robot, self.source)
        own = OwnMethod(self.name, checked_source(self.source), tuple(self.settings.items()))
        own.check_settings()
        return own

    def _packaged(self, robot: str, wanted: str) -> ComparedMethod:
        if wanted.endswith('.py'):
            raise ScriptError(f'{wanted} must be followed by what to take of it: {wanted}:NAME')
        known = methods_for(robot)
        (found,) = find_names('controller', [wanted], known)
        require_libraries([found])
        method = known[found]
        name = found if self.name == wanted else self.name
        if isinstance(method, NodeMethod):
            return replace(method, name=name, changes={**method.changes, **self.settings})
        assert isinstance(method, MethodSpec)
        return replace(method, name=name, parameters=method.parameters.with_values(self.settings))


def check_method(method: ComparedMethod, scenario: Scenario, cases: Sequence[str]) -> None:
    """Raise ValueError where a run would refuse the parameters of a method.

    Those of the node depend on the robot that it assumes; others are checked when they are set.
    """
    if isinstance(method, NodeMethod):
        for case in cases:
            method.parameters_for(replace(scenario, case=case))


def loaded(spec: str) -> Any:
    """Return the class, function or object that ``file.py:Name`` is.

    The functions of a plant go to other processes with the text of their file: by their name, as
    functions are sent, no other process finds them.
    """
    if FILE_SEPARATOR not in spec:
        raise ScriptError(f'robot must be twin, servo, torque or FILE.py:NAME: got {spec}')
    source = FileController.load(spec)
    found = source.resolve()
    if not is_dataclass(found) or isinstance(found, type):
        return found
    names = {id(value): name for name, value in vars(sys.modules[source.module]).items()}
    parts = {each.name: getattr(found, each.name) for each in fields(found)}
    own = {
        name: replace(source, name=names[id(value)])
        for name, value in parts.items()
        if getattr(value, '__module__', '') == source.module and id(value) in names
    }
    return replace(found, **own)


def as_controllers(given: Any) -> list[Controller]:
    """Return what a caller gave, one or a list or tuple, as :class:`Controller`."""
    sources = given if isinstance(given, list | tuple) else [given]
    return [each if isinstance(each, Controller) else Controller(each) for each in sources]


def _plain_name(source: Any) -> str:
    if isinstance(source, str):
        return source.rpartition(FILE_SEPARATOR)[2]
    return str(getattr(source, '__name__', type(source).__name__))


# -- controllers of one's own ---------------------------------------------------------------------


@dataclass(frozen=True)
class FileController:
    """A class or function of a Python file, with the text of the file.

    It can be sent to other machines: they need the file's imports, not the file.
    """

    path: str
    text: str
    name: str

    @classmethod
    def load(cls, spec: str) -> 'FileController':
        """Return that of ``file.py:Name``, after running the file."""
        stem, _, name = spec.rpartition(FILE_SEPARATOR)
        path = Path(f'{stem}.py').expanduser()
        if not path.is_file():
            raise ScriptError(f'there is no file {path}')
        found = cls(str(path), path.read_text(encoding='utf-8'), name)
        found.resolve()
        return found

    def resolve(self) -> Any:
        """Return the class, function or object itself."""
        content = vars(self._module())
        if self.name not in content:
            names = [
                name
                for name, value in content.items()
                if not name.startswith('_') and getattr(value, '__module__', '') == self.module
            ]
            raise ScriptError(
                f'{self.path} must define {self.name}: it defines {", ".join(names) or "nothing"}'
            )
        return content[self.name]

    def __call__(self, *arguments: Any) -> Any:
        """Return what the function returns."""
        return self.resolve()(*arguments)

    @property
    def __name__(self) -> str:
        """Name in errors and tables."""
        return self.name

    @property
    def module(self) -> str:
        """Name of the module of the file in each process."""
        digest = hashlib.sha256(self.text.encode()).hexdigest()[:12]
        return f'{Path(self.path).stem}_{digest}'

    def _module(self) -> ModuleType:
        """Return the module of the file, run once in each process.

        It is known before it has run, as a dataclass in it needs, but to no other thread.
        """
        with _RUNNING_A_FILE:
            if self.module in sys.modules:
                return sys.modules[self.module]
            module = module_from_spec(ModuleSpec(self.module, None, origin=self.path))
            sys.modules[self.module] = module
            folder = str(Path(self.path).resolve().parent)
            sys.path.insert(0, folder)  # as when the file is run as a program
            try:
                exec(compile(self.text, self.path, 'exec'), vars(module))
            except Exception as error:
                del sys.modules[self.module]
                text = f'{self.path} cannot be run: {described(error, self.path)}'
                raise ScriptError(text) from None
            finally:
                sys.path.remove(folder)
            return module


def _resolved(source: Any) -> Any:
    return source.resolve() if isinstance(source, FileController) else source


def checked_source(source: Any) -> Any:
    """Return a source that makes controllers, or raise :class:`ScriptError`."""
    if isinstance(source, str):
        source = FileController.load(source)
    found = _resolved(source)
    if isinstance(found, type):
        if not callable(getattr(found, 'step', None)):
            raise ScriptError(f'class {found.__name__} must have a method step(observation)')
    elif not (callable(getattr(found, 'step', None)) or callable(found)):
        raise ScriptError(
            'controller must be a name, a class with step(observation), an object of one, or a '
            f'function of the observation: got {type(found).__name__} {found!r}'
        )
    return source


@dataclass(frozen=True)
class OwnMethod:
    """A controller of one's own as a method of the closed loop."""

    name: str
    source: Any
    settings: tuple[tuple[str, Any], ...] = ()

    def __call__(self, nominal_model: NominalModel) -> BaselineController:
        """Return a new controller for a run."""
        source, settings = _resolved(self.source), dict(self.settings)
        if isinstance(source, type):
            made = self._instance(source, settings, nominal_model)
        elif callable(getattr(source, 'step', None)):
            made = deepcopy(source)
        else:
            return OwnController(self.name, partial(source, **settings), source, nominal_model)
        return OwnController(self.name, made.step, made, nominal_model)

    def check_settings(self) -> None:
        """Raise :class:`ScriptError` for a setting that its class or function does not take."""
        source, settings = _resolved(self.source), dict(self.settings)
        if not settings:
            return
        if isinstance(source, type) and issubclass(source, BaselineController):
            source.parameters_type().with_values(settings)
            return
        if not isinstance(source, type) and callable(getattr(source, 'step', None)):
            raise ScriptError(
                f'settings of {self.name} must be given to its class: it is an object already'
            )
        taken = [*inspect.signature(source).parameters.values()]
        if not isinstance(source, type):  # a function: its first argument is the observation
            taken = taken[1:]
        names = [each.name for each in taken if each.name != MODEL]
        unknown = [name for name in settings if name not in names]
        if unknown and all(each.kind is not each.VAR_KEYWORD for each in taken):
            raise ScriptError(
                f'settings of {_plain_name(source)} must be {", ".join(names) or "none"}: got '
                f'{unknown[0]}'
            )

    def driver(self, scenario: Scenario) -> MethodDriver:
        """Return a new driver for a run."""
        return MethodDriver(self, scenario)

    def knowledge(self, scenario: Scenario) -> str:
        """Return what it knows."""
        return f'Observation of each step; NominalModel by an argument {MODEL}'

    def _instance(self, kind: type, settings: Settings, nominal_model: NominalModel) -> Any:
        _check_class_data(kind)
        try:
            if issubclass(kind, BaselineController):
                return kind(kind.parameters_type().with_values(settings), nominal_model)
            if MODEL in inspect.signature(kind).parameters:
                settings = {MODEL: nominal_model, **settings}
            return kind(**settings)
        except ScriptError:
            raise
        except Exception as error:
            raise ScriptError(f'{self.name} cannot be made: {described(error)}') from None


def _check_class_data(kind: type) -> None:
    """Raise ScriptError if a run before has changed an object that all of a class share.

    The result of a run would depend on those before it in its process. Another object in its place
    is one that the script has set.
    """
    known = _CLASS_DATA.setdefault(kind, {})
    for name, value in vars(kind).items():
        if name.startswith('__') or hasattr(type(value), '__get__'):
            continue
        try:
            content = pickle.dumps(value)
        except (pickle.PicklingError, AttributeError, TypeError):
            continue
        before, content_before = known.setdefault(name, (value, content))
        if before is value and content != content_before:
            raise ScriptError(
                f'{kind.__name__}.{name} was changed by a run before, and would change the next '
                f'one: set self.{name} in __init__'
            )
        known[name] = value, content


@dataclass(frozen=True)
class NoParameters(Parameters):
    """The parameters of a controller of one's own are its settings."""


class OwnController(BaselineController):
    """Runs a step of one's own, and checks what it returns.

    It cuts nothing: the limits of the robot are in the loop.
    """

    parameters_type = NoParameters

    def __init__(
        self, name: str, step: Callable[[Observation], Any], made: Any, nominal_model: NominalModel
    ) -> None:
        super().__init__(NoParameters(), nominal_model)
        self.preview = bool(getattr(made, 'preview', False))  # type: ignore[misc]
        self._name, self._step = name, step
        self._applied = getattr(made, 'applied', None)
        self._steps = 0

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        at = f'at {self._steps * self._nominal_model.period:.2f} s'
        try:
            asked = self._step(_kept(observation))
        except Exception as error:
            text = f'{self._name} raised {described(error)}, {at}'
            raise ScriptError(f'{text}{_remedy(error, observation)}') from None
        what = ''
        if not isinstance(asked, np.ndarray):
            what = repr(asked)
        elif asked.shape != (2,) or asked.dtype.kind not in 'fiu':
            what = f'shape {asked.shape} of {asked.dtype}'
        if what:
            raise ScriptError(
                f'{self._name} must return a numpy array of shape (2,), the accelerations of the '
                f'right and the left wheel in rad/s²: got {what} {at}'
            )
        if not np.isfinite(asked).all():
            raise ScriptError(
                f'{self._name} must return finite accelerations: got {asked.tolist()} {at}'
            )
        self._steps += observation.elapsed
        return np.asarray(asked, dtype=np.float64).copy()

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Pass on the u that the limits let through, where the controller has ``applied``."""
        if self._applied is not None:
            self._applied(read_only(acceleration.copy()), limited=limited)


def _remedy(error: Exception, observation: Observation) -> str:
    """Return what to do about a mistake in a step that its error does not name."""
    if 'read-only' in str(error):
        return '; change a copy, such as observation.speeds.copy()'
    if isinstance(error, TypeError) and 'NoneType' in str(error) and observation.future is None:
        return '; observation.future is None without preview = True in the class'
    return ''


def _kept(observation: Observation) -> Observation:
    """Return an observation with arrays of its own, which cannot be written.

    Those of the loop change with every step, and ``error = observation.speeds; error -= ...`` in a
    controller of one's own would change what the estimator knows.
    """
    arrays: dict[str, Any] = {
        each.name: read_only(value.copy())
        for each in fields(observation)
        if isinstance(value := getattr(observation, each.name), np.ndarray)
    }
    return replace(observation, **arrays)


# -- scenario -------------------------------------------------------------------------------------


def own_scenario(
    plant: Any = 'twin',
    reference: Any = None,
    noise: Any = 0.04,
    faults: Any = None,
    duration: Any = 60.0,
    *,
    case: str = NOMINAL,
    seed: int = 1,
    robot_parameters: Mapping[str, Any] | None = None,
    gyro: bool = False,
) -> Scenario:
    """Return one run without its method; arguments as of :func:`simulate`.

    ``robot_parameters`` are changes of the true robot by name, unknown to all methods; ``gyro`` as
    of :class:`Scenario`. ValueError: wrong use, an unknown name, or a number out of range.
    """
    own_plant = plant if isinstance(plant, OdePlant | StateSpace) else None
    robot, own, text = _robot_of(plant)
    _check_kinds(noise, duration)
    law = noise if isinstance(noise, NoiseLaw) else None
    variance = noise.variance if isinstance(noise, NoiseLaw) else float(noise)
    if own_plant is not None:
        law = law or gaussian_noise(variance)
        if robot_parameters:
            raise ScriptError(
                'parameters of the robot must not be given for a plant of your own: got '
                f'{", ".join(robot_parameters)}'
            )
    course = None
    if reference is not None:
        Scenario(robot, NOMINAL, seed, duration)  # a wrong duration is an error before
        geometry = WheelGeometry() if own is None else own.plant_parameters().geometry
        course, text = sampled(reference, duration, geometry), f'{text}, your reference'
    links = faults if isinstance(faults, LinkFaults) else None
    events: Sequence[FaultEvent] = ()
    if faults is not None and links is None:
        events = _fault_events(faults, robot, duration)
    parts = OwnParts(
        reference=course,
        links=links,
        events=events,
        noise=law,
        nominal=None if own is None else own.plant_parameters(KINDS[robot].drive),
        limits=None if own is None else own.limits(),
        plant=own_plant,
        robot_parameters=robot_parameters or {},
        text=text,
    )
    found = Scenario(robot, case, seed, duration, variance, gyro, parts)
    found.true_robot()  # a wrong parameter of the robot is an error before the runs
    return found


def _robot_of(plant: Any) -> tuple[str, Robot | None, str]:
    """Return the robot of a plant by name, as given (None: of the package), and its text."""
    if isinstance(plant, str):
        (robot,) = find_names('plant', [plant], ROBOTS)
        return robot, None, KINDS[robot].text
    if isinstance(plant, Robot):
        return 'servo', plant, 'Your robot'
    if isinstance(plant, OdePlant | StateSpace):
        robot = 'torque' if plant.drive == 'torque' else 'servo'
        return robot, plant.robot, f'Your plant ({plant.name})'
    raise ScriptError(
        f'plant must be {", ".join(ROBOTS)}, a Robot, an OdePlant or a StateSpace: got '
        f'{type(plant).__name__} {plant!r}'
    )


def _check_kinds(noise: Any, duration: Any) -> None:
    """Raise ScriptError unless noise is a number or a law, and the duration a number."""
    if isinstance(noise, bool) or not isinstance(noise, int | float | NoiseLaw):
        raise ScriptError(
            'noise must be a variance in (rad/s)² or a NoiseLaw: got '
            f'{type(noise).__name__} {noise!r}'
        )
    if isinstance(duration, bool) or not isinstance(duration, int | float):
        raise ScriptError(f'duration must be a number of seconds: got {duration!r}')


def _fault_events(faults: Any, robot: str, duration: float) -> Sequence[FaultEvent]:
    """Return the events of a schedule or of its file, or raise ScriptError."""
    if robot != 'twin':
        raise ScriptError(
            'faults must be LinkFaults on a robot other than the twin: got '
            f'{type(faults).__name__}'
        )
    if not isinstance(faults, FaultSchedule | str | Path):
        raise ScriptError(
            'faults must be LinkFaults, a FaultSchedule, or the name or file of one: got '
            f'{type(faults).__name__} {faults!r}'
        )
    schedule = faults if isinstance(faults, FaultSchedule) else load_schedule(faults)
    events = schedule.events
    if events and all(event.at >= duration for event in events):
        raise ScriptError(
            f'faults must begin within the run, which lasts {duration:g} s: got '
            f'{min(event.at for event in events):g} s as the first begin'
        )
    return events
