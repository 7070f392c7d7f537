# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Experiments that the paper's tables and figures need: method, drive, noise and case."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from t3mpc_ros.evaluation.methods import ComparedMethod

DRIVES = ('torque', 'velocity')
"""How u reaches the wheels: as a torque, the paper's way, or as a wheel speed command."""
NOISES = (0.0, 0.01, 0.04, 0.1)
"""Noise variance of the measured wheel speeds, (rad/s)²: the paper's range."""
PAPER_NOISE = 0.04
"""The paper's own noise variance, (rad/s)²."""
NOMINAL = 'nominal'
EXACT = 'exact model'
"""In the name of a baseline whose model has the nominal inertia; the models of all other baselines
with preview believe in one that is 30 % off."""
DEAD_TIME = 'dead time'
"""The case that only the velocity drive has."""
FULL = 'full'
"""The controller with every part."""

STAGES = ('feedback', '+NT3FS', '+compensator', '+MPC', FULL)
"""The controller as it grows; the last step, to :data:`FULL`, adds preview."""
PARTS = ('NT3FS', 'compensator', 'MPC', 'preview')
"""Part that each stage adds."""
WITHOUT = {
    'NT3FS': 'full without NT3FS',
    'compensator': 'full without compensator',
    'MPC': 'full without MPC',
    'MPC, equal bound': 'full without MPC, equal bound',
    'preview': 'full without preview',
    'trained predictor': 'full with random predictor',
}
"""The full controller with one part left out, by that part."""


Jobs = Sequence[tuple[Any, Any]]


@dataclass(frozen=True, slots=True)
class ExperimentSetup:
    """Where methods and runs come from."""

    methods: Callable[[str], Mapping[str, 'ComparedMethod']]
    """The methods of a drive by name."""
    scenario: Callable[..., Any]
    """Called with drive, noise, case, seed and duration, by name; what
    ``measure_many`` takes."""
    measure_many: Callable[[Jobs, Callable[[Any], Any], Any], Iterable[tuple[int, Any]]]
    """Called with (scenario, method) pairs, what to make of the record of each run, and the team
    that works; yields (index, what was made) in any order."""
    cases: tuple[str, ...]
    """Every case there is, :data:`NOMINAL` first."""
    seeds: tuple[int, ...]
    """Held-out seeds, none of which has tuned anything."""
    team: Callable[[int], AbstractContextManager[Any]] = nullcontext
    """Called with how many processes; what it enters is the team. By default the number itself."""


DURATION = 59.5
"""Length of a run, s: four switches, and an end before the fifth, which methods with preview would
begin to cross without the run seeing what it is good for."""
BASELINE_CASES = ('mass +30 %', 'mass -30 %')
INTENDED_CASES = {
    WITHOUT['NT3FS']: ('mass +30 %', 'friction x3'),
    WITHOUT['compensator']: ('disturbance',),
    WITHOUT['MPC']: (DEAD_TIME, 'friction x3'),
    WITHOUT['MPC, equal bound']: (DEAD_TIME, 'friction x3'),
    WITHOUT['trained predictor']: (DEAD_TIME,),
}
"""The cases beside the nominal one in which the controller runs without a part."""


@dataclass(frozen=True, slots=True)
class ExperimentGrid:
    """How much is run."""

    seeds: tuple[int, ...]
    duration: float
    """s"""
    cases: tuple[str, ...]
    noises: tuple[float, ...] = NOISES
    perturbed_noises: tuple[float, ...] = NOISES
    """Noises at which the stages of the controller run the cases beside the nominal one."""
    missing_noises: tuple[float, ...] = (PAPER_NOISE,)
    """The same of the controller with one part left out."""
    baseline_noises: tuple[float, ...] = (PAPER_NOISE,)
    """The same of the baselines."""
    baseline_cases: tuple[str, ...] = BASELINE_CASES
    """The cases beside the nominal one that baselines with preview run."""
    drives: tuple[str, ...] = DRIVES

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise ValueError(f'seeds must be one or more, each once: got {self.seeds}')
        if not self.duration >= 5.0:
            raise ValueError(f'duration must be at least 5 s, 3 do not count: got {self.duration}')
        if NOMINAL not in self.cases:
            raise ValueError(f'cases must hold {NOMINAL}: got {self.cases}')


@dataclass(frozen=True, slots=True)
class Experiment:
    """One method in one situation: a row of the results."""

    method: str
    drive: str
    noise: float
    case: str


QUICK_CASES = (NOMINAL, 'mass +30 %', 'friction x3', 'disturbance', DEAD_TIME)


def make_grid(
    setup: ExperimentSetup, *, quick: bool = False, seeds: int | None = None
) -> ExperimentGrid:
    """Return how much is run: everything, or with ``quick`` enough to see that all works.

    Raises
    ------
    ValueError
        More seeds are asked for than are held out.
    """
    count = (3 if quick else len(setup.seeds)) if seeds is None else seeds
    if not 1 <= count <= len(setup.seeds):
        raise ValueError(f'seeds must be from 1 to {len(setup.seeds)}: got {count}')
    if not quick:
        return ExperimentGrid(
            setup.seeds[:count], DURATION, setup.cases, perturbed_noises=(0.0, PAPER_NOISE)
        )
    cases = tuple(case for case in QUICK_CASES if case in setup.cases)
    return ExperimentGrid(
        setup.seeds[:count], 26.0, cases, (0.0, PAPER_NOISE), (PAPER_NOISE,), (PAPER_NOISE,), ()
    )


def needed_experiments(setup: ExperimentSetup, grid: ExperimentGrid) -> tuple[Experiment, ...]:
    """Return all needed experiments without duplicates, by drive, case, noise and method.

    Every baseline and every stage of the controller in the nominal case at every noise; the stages
    in every other case at ``perturbed_noises``; the controller with one part left out in the
    cases that part is for, at ``missing_noises``; baselines with preview in ``baseline_cases``
    at ``baseline_noises``.

    Raises
    ------
    ValueError
        A drive has no controller named :data:`FULL`, a method another name than its key, or a
        stage of the controller is called a baseline.
    """
    found = []
    for drive in grid.drives:
        methods = setup.methods(drive)
        if FULL not in methods or any(name != method.name for name, method in methods.items()):
            names = ', '.join(methods)
            raise ValueError(f'methods of {drive} must hold {FULL}, by their names: got {names}')
        if wrong := [name for name in (*STAGES, *WITHOUT.values()) if _is_baseline(methods, name)]:
            raise ValueError(
                f'stages of the controller must not be baselines: got {", ".join(wrong)}'
            )
        for case in grid.cases:
            if case == DEAD_TIME and drive != 'velocity':
                continue
            for noise in grid.noises:
                for name, method in methods.items():
                    if noise in _noises(grid, method, case):
                        found.append(Experiment(name, drive, noise, case))
    return tuple(found)


def _noises(grid: ExperimentGrid, method: 'ComparedMethod', case: str) -> tuple[float, ...]:
    """Return the noises at which a method runs a case."""
    if method.name in WITHOUT.values():
        wanted = case == NOMINAL or case in INTENDED_CASES.get(method.name, ())
        return grid.missing_noises if wanted else ()
    if case == NOMINAL:
        return grid.noises
    if method.baseline:
        return grid.baseline_noises if method.preview and case in grid.baseline_cases else ()
    return grid.perturbed_noises


def _is_baseline(methods: Mapping[str, 'ComparedMethod'], name: str) -> bool:
    return name in methods and methods[name].baseline
