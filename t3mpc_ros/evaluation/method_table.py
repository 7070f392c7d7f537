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
"""Table of compared methods: the baselines, and the proposed controller with its ablations."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from importlib import import_module
from typing import TypeVar

from t3mpc_ros.control.input_shaper import InputShaperParameters
from t3mpc_ros.evaluation.baselines import feedback_control
from t3mpc_ros.evaluation.baselines.baseline_controller import BaselineController
from t3mpc_ros.evaluation.baselines.dynamic_matrix_control import (
    DynamicMatrix,
    DynamicMatrixPreview,
)
from t3mpc_ros.evaluation.baselines.feed_forward import (
    FeedForward,
    FeedForwardParameters,
    LmsBodyCorrection,
    LmsBodyCorrectionParameters,
)
from t3mpc_ros.evaluation.baselines.feedback_control import AdaptiveIntervalType2, AdaptiveType1
from t3mpc_ros.evaluation.baselines.model_predictive_control import (
    CasadiNmpc,
    LinearMpc,
    LinearMpcPreview,
)
from t3mpc_ros.evaluation.cases import NOMINAL
from t3mpc_ros.evaluation.loop import MethodSpec, NodeMethod
from t3mpc_ros.evaluation.proposed_method import ProposedController, ProposedParameters
from t3mpc_ros.evaluation.scenario import KINDS, PLANT_OF, Scenario
from t3mpc_ros.evaluation.tuning.tuned_parameters import (
    PACKAGED_FILE,
    MethodDefinition,
    SearchRange,
    TunedParameters,
)
from t3mpc_ros.parameters.table import Parameters

FULL = 'full'
NMPC = 'CasADi NMPC'
OFFSET_FREE = 'offset-free MPC'
RAMP = ' + ramp'
"""Suffix of the name of a feedback baseline with the preview and the ramp of the controller."""
EXACT_MODEL = ', exact model'
"""Suffix of the name of a method whose model has no error."""
MODEL_ERROR = 1.3
"""Ratio of model inertia to true inertia of the predictive baselines with preview."""
FULL_WRONG = f'{FULL}, inertia × {MODEL_ERROR:g}'
"""The full controller with this error, on the torque drive."""
Tunable = TypeVar('Tunable', bound=Parameters)

FEED_FORWARD = 'feed-forward'
"""The method with which every other is compared."""
SHAPED = 'feed-forward + shaper'
SHAPED_IN_TIME = 'feed-forward + shaper + dead time'
IN_TIME = 'feed-forward + dead time'
LMS = 'LMS body correction'
TWIN_ADVANCE = 0.0104
"""Lead of feed-forward over the dead time on the twin, s: T/(1 - exp(-T/lag)), by which the law of
the controller is ahead when its feedback cancels the measured speed."""

_NO_FUZZY, _NO_COMPENSATOR = {'use_fuzzy': False}, {'law.compensator': False}
_NO_MPC, _NO_PREVIEW = {'predictive.enabled': False}, {'jump_transition.preview': False}
STAGES: Mapping[str, Mapping[str, object]] = {
    'feedback': _NO_FUZZY | _NO_COMPENSATOR | _NO_MPC | _NO_PREVIEW,
    '+NT3FS': _NO_COMPENSATOR | _NO_MPC | _NO_PREVIEW,
    '+compensator': _NO_MPC | _NO_PREVIEW,
    '+MPC': _NO_PREVIEW,
    FULL: {},
}
"""Stages of the controller, as changes of the full one; the last stage adds preview."""

WITHOUT: Mapping[str, Mapping[str, object]] = {
    'full without NT3FS': _NO_FUZZY,
    'full without compensator': _NO_COMPENSATOR,
    'full without MPC': _NO_MPC,
    'full without MPC, equal bound': {
        **_NO_MPC,
        'law.error_bound': ProposedParameters().compensated_bound,
    },
    'full without preview': _NO_PREVIEW,
    'full with random predictor': {'random_predictor': True, 'predictive.learning': False},
}
"""The full controller with one part left out. Without v_p the bound (80) of the compensator is
lower too; with equal bound it stays, which isolates the effect of v_p."""


TWIN_PARTS: Mapping[str, Mapping[str, object]] = {
    'full without body correction': {'body.enabled': False},
    'full without compensator': {'body.yaw_gain': 0.0},
    'full without shaper': {
        'command_shaper.straight_frequency': 0.0,
        'command_shaper.turning_frequency': 0.0,
    },
    'full without dead-time estimate': {'estimate_dead_time': False},
    'full without preview': _NO_PREVIEW,
    "full, the paper's composition": {'composition': 'paper'},
}
"""The node's controller on the twin with one part left out, and with NT3FS, compensator and v_p on
the wheel speeds. The compensator is that of the yaw error (E21), with the authority of the gains:
without the body correction, neither acts."""


PAPER_PARTS = "full, the paper's parts"
"""The controller of the paper's study, where the full one of comparisons has other parts."""
ON_TORQUE: Mapping[str, object] = {
    'law.gain': 12.0,
    'law.error_bound': 1.5,
    'adaptation.gamma': 100.0,
    'friction.gamma': 6.0,
    'inertia.gamma': 300.0,
    'nominal_loads': True,
    'predictive.enabled': False,
}
"""Changes of the paper's controller with which a torque drive is tracked better: NT3FS learns what
differs from the nominal robot, a wrong inertia has a basis of its own (E24), and the predictive
term, which brings no improvement beside them, is off. Chosen on seeds 2001 to 2003."""
TORQUE_PARTS: Mapping[str, Mapping[str, object]] = {
    'full with MPC': {'predictive.enabled': True},
    'full without NT3FS': _NO_FUZZY,
    'full without compensator': _NO_COMPENSATOR,
    'full without inertia term': {'inertia.gamma': 0.0},
    'full without nominal loads': {'nominal_loads': False},
    'full without preview': _NO_PREVIEW,
}
"""That controller with one part more or less."""


def require_libraries(names: Iterable[str]) -> None:
    """Raise ModuleNotFoundError if one of these methods needs a library that is not installed."""
    if any(name.startswith(NMPC) for name in names):
        import_module('casadi')


_GAIN = SearchRange('gain', 5.0, 80.0)
_INTEGRAL = SearchRange('integral', 0.3, 3000.0)
_MOVES = SearchRange('move_time', 0.001, 0.1), SearchRange('disturbance_share', 0.01, 1.5)
_ADAPTIVE = (
    _GAIN,
    SearchRange('normalised_gain', 1.0, 2000.0),
    SearchRange('dead_zone', 0.003, 0.3),
    SearchRange('error_bound', 0.0, 8.0, log=False),
)
_MPC = *_MOVES, SearchRange('integral_time', 0.1, 40.0), SearchRange('filter_time', 0.003, 2.0)
_DMC = _MOVES[0], SearchRange('bias_time', 0.005, 15.0), _MOVES[1]
_ADRC = (
    _GAIN,
    SearchRange('observer_bandwidth', 1.0, 150.0),
    SearchRange('shared_disturbance', 0.0, 1.0, log=False),
    SearchRange('shared_speed', 0.0, 1.0, log=False),
)
_SLIDING = (
    SearchRange('surface', 0.3, 60.0),
    SearchRange('reaching', 1.0, 80.0),
    SearchRange('switching', 0.3, 30.0),
    SearchRange('boundary', 0.03, 3.0),
)
_WRONG = {'model_error': MODEL_ERROR}
_PLAIN = {'load_share': 0.0}
_INNER = {'load_share': 0.0, 'inner_gain': 15.0}
_BASELINES: tuple[
    tuple[str, type[BaselineController], Mapping[str, float], tuple[SearchRange, ...]], ...
] = (
    ('PI + feed-forward', feedback_control.ProportionalIntegral, {}, (_GAIN, _INTEGRAL)),
    ('ADRC', feedback_control.DisturbanceRejection, {}, _ADRC),
    ('sliding mode', feedback_control.SlidingMode, {}, _SLIDING),
    (
        'computed torque',
        feedback_control.ComputedTorque,
        {},
        (_GAIN, _INTEGRAL, SearchRange('belief', 0.0, 1.3, log=False)),
    ),
    ('adaptive T1-FLS', AdaptiveType1, {}, _ADAPTIVE),
    ('adaptive IT2-FLS', AdaptiveIntervalType2, {}, _ADAPTIVE),
    ('DMC', DynamicMatrix, _INNER, _DMC),
    ('DMC preview', DynamicMatrixPreview, _INNER | _WRONG, _DMC),
    ('linear MPC', LinearMpc, _PLAIN, _MPC),
    ('linear MPC preview', LinearMpcPreview, _PLAIN | _WRONG, _MPC),
    (NMPC, CasadiNmpc, _WRONG, _MPC),
)
"""Name, class, parameters other than the defaults, and search ranges."""


def method_definitions() -> list[MethodDefinition]:
    """Return every tunable method, each with a few search ranges.

    A switch is the same for all methods without preview: they cross it as fast as the drive
    allows, and what is left to choose there is fixed at values that do not matter (1 %).
    """
    full = (
        SearchRange('law.gain', 5.0, 80.0),
        SearchRange('law.smoothing', 0.1, 10.0),
        SearchRange('adaptation.gamma', 30.0, 30000.0),
        SearchRange('integral_transfer', 0.01, 1.0),
        SearchRange('predictive.move_weight', 1e-4, 1.0),
        SearchRange('predictive.offset_gain', 0.003, 0.5),
    )
    found = []
    for name, kind, changes, ranges in _BASELINES:
        start = kind.parameters_type().with_values(changes)
        found.append(MethodDefinition(name, kind, dict.fromkeys(PLANT_OF, start), ranges))
    return [*found, MethodDefinition(FULL, ProposedController, proposed_parameters(), full)]


def proposed_parameters() -> dict[str, Parameters]:
    """Return the parameters of the proposed controller for each drive before tuning.

    Torques are not limited as a stepper's acceleration is: switches are crossed faster.
    """
    velocity = ProposedParameters()
    torque = velocity.with_values({'law.gain': 12.0, 'jump_transition.acceleration': 200.0})
    return {'torque': torque, 'velocity': velocity}


def further_definitions() -> list[MethodDefinition]:
    """Return the tunable methods that are in comparisons and not in the paper's study.

    Feedback baselines with the preview and the ramp of the controller; linear MPC that knows the
    exact inertia and estimates the disturbance by itself; the simplest correction of the body.
    """
    found = []
    for name, kind, changes, ranges in _BASELINES:
        if issubclass(kind, feedback_control.FeedbackBaseline):
            start = kind.parameters_type().with_values(
                {**changes, 'jump_transition.preview': True}
            )
            starts = {drive: _with_ramp_of(drive, start) for drive in PLANT_OF}
            found.append(MethodDefinition(name + RAMP, kind, starts, ranges))
    free = LinearMpcPreview.parameters_type().with_values({**_PLAIN, 'disturbance_share': 0.0})
    ranges = tuple(each for each in _MPC if each.name != 'disturbance_share')
    starts = dict.fromkeys(PLANT_OF, free)
    found.append(MethodDefinition(OFFSET_FREE, LinearMpcPreview, starts, ranges))
    lms = feed_forward_on_the_twin(LmsBodyCorrectionParameters)
    ranges = (SearchRange('learning_rate', 1e-4, 1.0),)
    return [*found, MethodDefinition(LMS, LmsBodyCorrection, {'twin': lms}, ranges)]


def feed_forward_on_the_twin(table: type[FeedForwardParameters]) -> FeedForwardParameters:
    """Return the parameters of a feed-forward with the shaper of the node and its dead time."""
    shaper = InputShaperParameters()
    return table(advance=TWIN_ADVANCE, estimate_dead_time=True, command_shaper=shaper)


def _with_ramp_of(drive: str, parameters: Tunable) -> Tunable:
    """Return the parameters with the ramp of the proposed controller on a drive."""
    ramp = proposed_parameters()[drive].to_dict()['jump_transition.acceleration']
    return parameters.with_values({'jump_transition.acceleration': ramp})


def methods(drive: str, store: TunedParameters | None = None) -> dict[str, MethodSpec]:
    """Return every method of the paper's study by name, with its tuned parameters.

    StoreError: a method was not tuned in this drive, what is stored does not fit it any more, or
    the methods were not tuned with equal effort.
    """
    tuned = TunedParameters.load(PACKAGED_FILE) if store is None else store
    tuned.check_equal()
    found: dict[str, MethodSpec] = {}
    for each in method_definitions():
        parameters = tuned.applied(each.name, drive, each.start[drive])
        if each.name == FULL:
            found |= _variants(parameters, {**STAGES, **WITHOUT})
            continue
        found[each.name] = MethodSpec(each.name, each.controller_type, parameters, True)
    for name in ('linear MPC preview', NMPC):
        wrong, exact = found[name], f'{name}{EXACT_MODEL}'
        parameters = wrong.parameters.with_values({'model_error': 1.0})
        found[exact] = replace(wrong, name=exact, parameters=parameters)
    return found


def further_methods(drive: str) -> dict[str, MethodSpec]:
    """Return the methods of :func:`further_definitions` on the paper's plant.

    With the ramp, gains that were not tuned with it are those tuned without; offset-free MPC has
    those of the linear one with preview.
    """
    tuned = TunedParameters.load(PACKAGED_FILE)
    return {
        each.name: MethodSpec(
            each.name,
            each.controller_type,
            tuned_parameters(tuned, each.name, drive, each.start[drive]),
            True,
        )
        for each in further_definitions()
        if drive in each.start
    }


def tuned_parameters(tuned: TunedParameters, name: str, drive: str, start: Tunable) -> Tunable:
    """Return ``start`` with what was tuned for a method, else for the one that it is made of."""
    exact = name.removesuffix(EXACT_MODEL)
    for each in (exact, exact.removesuffix(RAMP)):
        if (each, drive) in tuned:
            return tuned.applied(each, drive, start)
    if name == OFFSET_FREE:
        values = {'disturbance_share': start.to_dict()['disturbance_share']}
        return tuned.applied('linear MPC preview', drive, start).with_values(values)
    return start


def _variants(
    full: Parameters, parts: Mapping[str, Mapping[str, object]]
) -> dict[str, MethodSpec]:
    """Return the proposed controller with changes of its parameters, by name."""
    return {
        name: MethodSpec(name, ProposedController, full.with_values(changes), True, baseline=False)
        for name, changes in parts.items()
    }


@cache
def methods_for(robot: str) -> Mapping[str, MethodSpec | NodeMethod]:
    """Return the methods of a robot by name; the first one is the full controller."""
    drive = KINDS[robot].drive
    table, further = methods(drive), further_methods(drive)
    forward = MethodSpec(FEED_FORWARD, FeedForward, feed_forward_parameters(robot))
    if robot == 'twin':
        return _twin_methods(table | further, forward)
    found: dict[str, MethodSpec | NodeMethod] = {FULL: table[FULL], FEED_FORWARD: forward}
    if drive == 'velocity':
        values = {'estimate_dead_time': True}
        parameters = forward.parameters.with_values(values)
        found[IN_TIME] = MethodSpec(IN_TIME, FeedForward, parameters)
        return found | table | further
    parts = {FULL: {}, FULL_WRONG: {'inertia_error': MODEL_ERROR}, **TORQUE_PARTS}
    found |= _variants(table[FULL].parameters.with_values(ON_TORQUE), parts)
    found[PAPER_PARTS] = replace(table[FULL], name=PAPER_PARTS)
    return found | {name: each for name, each in table.items() if each.baseline} | further


def feed_forward_parameters(robot: str) -> FeedForwardParameters:
    """Return the parameters of feed-forward on a robot."""
    if robot == 'twin':
        return FeedForwardParameters(advance=TWIN_ADVANCE)
    # The ramp that the other methods with preview have there.
    return _with_ramp_of(KINDS[robot].drive, FeedForwardParameters())


def _twin_methods(
    table: Mapping[str, MethodSpec], forward: MethodSpec
) -> Mapping[str, MethodSpec | NodeMethod]:
    """Return the methods on the twin.

    The full controller has the defaults of the node, whatever is stored as tuned for it.
    Baselines have the parameters tuned for the twin; those of a baseline that was not are its
    :func:`twin_start`.
    """
    tuned, twin = TunedParameters.load(), KINDS['twin'].tuned_for
    in_time = feed_forward_on_the_twin(FeedForwardParameters)
    shaped = in_time.with_values({'estimate_dead_time': False})
    lms = feed_forward_on_the_twin(LmsBodyCorrectionParameters)
    found: dict[str, MethodSpec | NodeMethod] = {
        FULL: NodeMethod(FULL, {}),
        FEED_FORWARD: forward,
        SHAPED: MethodSpec(SHAPED, FeedForward, shaped),
        SHAPED_IN_TIME: MethodSpec(SHAPED_IN_TIME, FeedForward, in_time),
        LMS: MethodSpec(LMS, LmsBodyCorrection, tuned_parameters(tuned, LMS, twin, lms)),
    }
    for name, method in table.items():
        if method.baseline:
            parameters = tuned_parameters(tuned, name, twin, twin_start(method.parameters))
            found[name] = MethodSpec(name, method.controller_type, parameters)
    return found | {name: NodeMethod(name, changes) for name, changes in TWIN_PARTS.items()}


def twin_start(parameters: Parameters) -> Parameters:
    """Return the parameters of a baseline before tuning on the twin.

    They are those tuned for the velocity drive, with the feedback gain ``gain`` at which the
    measured speed cancels in the command, (1 - exp(-T/lag))/T.
    """
    if 'gain' not in parameters.to_dict():
        return parameters
    model = Scenario('twin', NOMINAL, 0).nominal_model()
    return parameters.with_values({'gain': model.share / model.period})


def default_methods(robot: str) -> tuple[str, ...]:
    """Return the full controller and every baseline, without stages and ablations.

    Of a baseline that can use preview it is the variant with it.
    """
    known = methods_for(robot)
    parts = {*STAGES, *WITHOUT, *TWIN_PARTS, *TORQUE_PARTS} - {FULL}
    without = {name for name in known if {name + RAMP, f'{name} preview'} & {*known}}
    return tuple(name for name in known if name not in parts | without)
