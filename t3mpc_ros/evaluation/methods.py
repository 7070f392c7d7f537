# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Table of compared methods: the baselines, and the proposed controller with its ablations."""

from collections.abc import Iterable, Mapping
from functools import cache
from importlib import import_module

from t3mpc_ros.evaluation.baselines.adaptive_fuzzy import AdaptiveIntervalType2, AdaptiveType1
from t3mpc_ros.evaluation.baselines.baseline_controller import BaselineController
from t3mpc_ros.evaluation.baselines.dynamic_matrix_control import (
    DynamicMatrix,
    DynamicMatrixPreview,
)
from t3mpc_ros.evaluation.baselines.feed_forward import FeedForward, FeedForwardParameters
from t3mpc_ros.evaluation.baselines.feedback_control import (
    ComputedTorque,
    DisturbanceRejection,
    ProportionalIntegral,
    SlidingMode,
)
from t3mpc_ros.evaluation.baselines.linear_mpc import LinearMpc, LinearMpcPreview
from t3mpc_ros.evaluation.baselines.nonlinear_mpc import CasadiNmpc
from t3mpc_ros.evaluation.cases import NOMINAL
from t3mpc_ros.evaluation.drivers import MethodSpec, NodeMethod
from t3mpc_ros.evaluation.proposed_method import ProposedController, ProposedParameters
from t3mpc_ros.evaluation.scenario import KINDS, PLANT_OF, Scenario
from t3mpc_ros.evaluation.tuning.search_space import MethodDefinition, SearchRange
from t3mpc_ros.evaluation.tuning.tuned_parameters import PACKAGED_FILE, TunedParameters
from t3mpc_ros.parameters.table import Parameters

FULL = 'full'
NMPC = 'CasADi NMPC'
EXACT_MODEL = ', exact model'
"""Suffix of the name of a method whose model has no error."""
MODEL_ERROR = 1.3
"""Ratio of model inertia to true inertia of the predictive baselines with preview."""

FEED_FORWARD = 'feed-forward'
"""The method with which every other is compared."""
TWIN_ADVANCE = 0.0095
"""Lead of feed-forward over the dead time on the twin, s: its pulse generator ramps to a command
during the whole period that follows, and its rotors have hardly any lag."""

STAGES: Mapping[str, Mapping[str, object]] = {
    'feedback': {
        'use_fuzzy': False,
        'law.compensator': False,
        'predictive.enabled': False,
        'jump_transition.preview': False,
    },
    '+NT3FS': {
        'law.compensator': False,
        'predictive.enabled': False,
        'jump_transition.preview': False,
    },
    '+compensator': {'predictive.enabled': False, 'jump_transition.preview': False},
    '+MPC': {'jump_transition.preview': False},
    FULL: {},
}
"""Stages of the controller, as changes of the full one; the last stage adds preview."""

WITHOUT: Mapping[str, Mapping[str, object]] = {
    'full without NT3FS': {'use_fuzzy': False},
    'full without compensator': {'law.compensator': False},
    'full without MPC': {'predictive.enabled': False},
    'full without MPC, equal bound': {
        'predictive.enabled': False,
        'law.error_bound': ProposedParameters().compensated_bound,
    },
    'full without preview': {'jump_transition.preview': False},
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
    'full without preview': {'jump_transition.preview': False},
    "full, the paper's composition": {'composition': 'paper'},
}
"""The node's controller on the twin with one part left out, and with NT3FS, compensator and v_p on
the wheel speeds. The compensator is that of the yaw error (E21), with the authority of the gains:
without the body correction, neither acts."""


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
    ('PI + feed-forward', ProportionalIntegral, {}, (_GAIN, _INTEGRAL)),
    ('ADRC', DisturbanceRejection, {}, _ADRC),
    ('sliding mode', SlidingMode, {}, _SLIDING),
    (
        'computed torque',
        ComputedTorque,
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


def methods(drive: str, store: TunedParameters | None = None) -> dict[str, MethodSpec]:
    """Return every compared method by name, with its tuned parameters.

    StoreError: a method was not tuned in this drive, what is stored does not fit it any more, or
    the methods were not tuned with equal effort.
    """
    tuned = TunedParameters.load(PACKAGED_FILE) if store is None else store
    tuned.check_equal()
    found: dict[str, MethodSpec] = {}
    for each in method_definitions():
        parameters = tuned.applied(each.name, drive, each.start[drive])
        if each.name == FULL:
            found |= _proposed_methods(parameters)
            continue
        found[each.name] = MethodSpec(each.name, each.controller_type, parameters, True)
    for name in ('linear MPC preview', NMPC):
        if name in found:
            wrong, exact = found[name], f'{name}{EXACT_MODEL}'
            parameters = wrong.parameters.with_values({'model_error': 1.0})
            found[exact] = MethodSpec(exact, wrong.controller_type, parameters, True)
    return found


def _proposed_methods(full: Parameters) -> dict[str, MethodSpec]:
    return {
        name: MethodSpec(name, ProposedController, full.with_values(changes), True, baseline=False)
        for name, changes in {**STAGES, **WITHOUT}.items()
    }


@cache
def methods_for(robot: str) -> Mapping[str, MethodSpec | NodeMethod]:
    """Return the methods of a robot by name; the first one is the full controller."""
    table = methods(KINDS[robot].drive)
    forward = MethodSpec(FEED_FORWARD, FeedForward, feed_forward_parameters(robot))
    ordered: dict[str, MethodSpec | NodeMethod]
    ordered = {FULL: table[FULL], FEED_FORWARD: forward, **table}
    return _twin_methods(table, forward) if robot == 'twin' else ordered


def feed_forward_parameters(robot: str) -> FeedForwardParameters:
    """Return the parameters of feed-forward on a robot."""
    if robot == 'twin':
        return FeedForwardParameters(advance=TWIN_ADVANCE)
    if robot == 'torque':  # the ramp that the other methods with preview have there
        return FeedForwardParameters().with_values({'jump_transition.acceleration': 200.0})
    return FeedForwardParameters()


def _twin_methods(
    table: Mapping[str, MethodSpec], forward: MethodSpec
) -> Mapping[str, MethodSpec | NodeMethod]:
    """Return the methods on the twin.

    The full controller has the defaults of the node, whatever is stored as tuned for it.
    Baselines have the parameters tuned for the twin; those of a baseline that was not are its
    :func:`twin_start`.
    """
    tuned = TunedParameters.load()
    found: dict[str, MethodSpec | NodeMethod] = {
        FULL: NodeMethod(FULL, {}),
        FEED_FORWARD: forward,
    }
    for name, method in table.items():
        if method.baseline:
            parameters = twin_start(method.parameters)
            tuned_name = name.removesuffix(EXACT_MODEL)
            if (tuned_name, KINDS['twin'].tuned_for) in tuned:
                parameters = tuned.applied(tuned_name, KINDS['twin'].tuned_for, parameters)
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
    """Return the full controller and every baseline, without stages and ablations."""
    parts = {*STAGES, *WITHOUT, *TWIN_PARTS} - {FULL}
    return tuple(name for name in methods_for(robot) if name not in parts)
