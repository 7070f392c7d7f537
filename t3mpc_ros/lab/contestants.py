# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The table of methods that are compared: what each may tune, and how it is then run."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec

from t3mpc_ros.lab.composed import Composed, ComposedSettings
from t3mpc_ros.lab.rivals.adaptive import (
    AdaptiveIntervalType2,
    AdaptiveIntervalType2Settings,
    AdaptiveType1,
    AdaptiveType1Settings,
)
from t3mpc_ros.lab.rivals.casadi_nmpc import CasadiNmpc, CasadiNmpcSettings
from t3mpc_ros.lab.rivals.dmc import (
    DynamicMatrix,
    DynamicMatrixPreview,
    DynamicMatrixPreviewSettings,
    DynamicMatrixSettings,
)
from t3mpc_ros.lab.rivals.linear import (
    DisturbanceRejection,
    DisturbanceRejectionSettings,
    ProportionalIntegral,
    ProportionalIntegralSettings,
)
from t3mpc_ros.lab.rivals.linear_mpc import (
    LinearMpc,
    LinearMpcPreview,
    LinearMpcPreviewSettings,
    LinearMpcSettings,
)
from t3mpc_ros.lab.rivals.robust import (
    ComputedTorque,
    ComputedTorqueSettings,
    SlidingMode,
    SlidingModeSettings,
)
from t3mpc_ros.lab.trial.loop import MethodSpec
from t3mpc_ros.lab.trial.scenario import DRIVES
from t3mpc_ros.lab.tuning.contestant import Contestant
from t3mpc_ros.lab.tuning.space import Range
from t3mpc_ros.lab.tuning.store import SHIPPED, TunedStore
from t3mpc_ros.settings import Settings

FULL = 'full'
WRONG = 1.3
"""Inertia that the models of the predictive rivals with preview believe in, over the true one."""

STAGES: Mapping[str, Mapping[str, object]] = {
    'feedback': {
        'use_fuzzy': False,
        'law.compensator': False,
        'predictive.enabled': False,
        'switches.preview': False,
    },
    '+NT3FS': {
        'law.compensator': False,
        'predictive.enabled': False,
        'switches.preview': False,
    },
    '+compensator': {'predictive.enabled': False, 'switches.preview': False},
    '+MPC': {'switches.preview': False},
    FULL: {},
}
"""The controller as it grows, as changes of the full one; the last step adds preview."""

WITHOUT: Mapping[str, Mapping[str, object]] = {
    'full without NT3FS': {'use_fuzzy': False},
    'full without compensator': {'law.compensator': False},
    'full without MPC': {'predictive.enabled': False},
    'full without MPC, equal bound': {
        'predictive.enabled': False,
        'law.error_bound': ComposedSettings().compensated_bound,
    },
    'full without preview': {'switches.preview': False},
    'full with random predictor': {'random_predictor': True, 'predictive.learning': False},
}
"""The full controller with one part left out. Without v_p the bound (80) of the compensator is
lower too; with equal bound it stays, which shows what v_p is worth by itself."""


@dataclass(frozen=True, slots=True)
class Entrant(MethodSpec):
    """A method as it is run, and how tables sort it."""

    rival: bool = True
    """Whether it is somebody else's method, not a stage of ours."""
    preview: bool = False
    """Whether it is told the future of the reference."""


def _both(settings: Settings) -> dict[str, Settings]:
    return dict.fromkeys(DRIVES, settings)


def contestants() -> list[Contestant]:
    """Return every method that is tuned, each with a handful of settings to search.

    A switch is the same for all methods without preview: they cross it as fast as the drive
    allows, and what is left to choose there is fixed at values that do not matter (1 %).
    """
    gain = Range('gain', 5.0, 80.0)
    adaptive = (
        gain,
        Range('normalised_gain', 1.0, 2000.0),
        Range('dead_zone', 0.003, 0.3),
        Range('error_bound', 0.0, 8.0, log=False),
    )
    mpc = (
        Range('move_time', 0.001, 0.1),
        Range('disturbance_share', 0.01, 1.5),
        Range('integral_time', 0.1, 40.0),
        Range('filter_time', 0.003, 2.0),
    )
    dmc = (
        Range('move_time', 0.001, 0.1),
        Range('bias_time', 0.005, 15.0),
        Range('disturbance_share', 0.01, 1.5),
    )
    nonlinear = []
    if find_spec('casadi') is not None:
        start = _both(CasadiNmpcSettings(model_error=WRONG))
        nonlinear = [Contestant('CasADi NMPC', CasadiNmpc, start, mpc)]
    return [
        Contestant(
            'PI + feed-forward',
            ProportionalIntegral,
            _both(ProportionalIntegralSettings()),
            (gain, Range('integral', 0.3, 3000.0)),
        ),
        Contestant(
            'ADRC',
            DisturbanceRejection,
            _both(DisturbanceRejectionSettings()),
            (
                gain,
                Range('observer_bandwidth', 1.0, 150.0),
                Range('shared_disturbance', 0.0, 1.0, log=False),
                Range('shared_speed', 0.0, 1.0, log=False),
            ),
        ),
        Contestant(
            'sliding mode',
            SlidingMode,
            _both(SlidingModeSettings()),
            (
                Range('surface', 0.3, 60.0),
                Range('reaching', 1.0, 80.0),
                Range('switching', 0.3, 30.0),
                Range('boundary', 0.03, 3.0),
            ),
        ),
        Contestant(
            'computed torque',
            ComputedTorque,
            _both(ComputedTorqueSettings()),
            (gain, Range('integral', 0.3, 3000.0), Range('belief', 0.0, 1.3, log=False)),
        ),
        Contestant('adaptive T1-FLS', AdaptiveType1, _both(AdaptiveType1Settings()), adaptive),
        Contestant(
            'adaptive IT2-FLS',
            AdaptiveIntervalType2,
            _both(AdaptiveIntervalType2Settings()),
            adaptive,
        ),
        Contestant(
            'DMC',
            DynamicMatrix,
            _both(DynamicMatrixSettings(load_share=0.0, inner_gain=15.0)),
            dmc,
        ),
        Contestant(
            'DMC preview',
            DynamicMatrixPreview,
            _both(
                DynamicMatrixPreviewSettings(load_share=0.0, inner_gain=15.0, model_error=WRONG)
            ),
            dmc,
        ),
        Contestant('linear MPC', LinearMpc, _both(LinearMpcSettings(load_share=0.0)), mpc),
        Contestant(
            'linear MPC preview',
            LinearMpcPreview,
            _both(LinearMpcPreviewSettings(load_share=0.0, model_error=WRONG)),
            mpc,
        ),
        *nonlinear,
        Contestant(
            FULL,
            Composed,
            ours(),
            (
                Range('law.gain', 5.0, 80.0),
                Range('law.smoothing', 0.1, 10.0),
                Range('adaptation.gamma', 30.0, 30000.0),
                Range('handover', 0.01, 1.0),
                Range('predictive.move_weight', 1e-4, 1.0),
                Range('predictive.offset_gain', 0.003, 0.5),
            ),
        ),
    ]


def ours() -> dict[str, Settings]:
    """Return our settings for each drive before tuning.

    Torques are not limited as a stepper's acceleration is: switches are crossed faster.
    """
    velocity = ComposedSettings()
    torque = velocity.changed({'law.gain': 12.0, 'switches.acceleration': 200.0})
    return {'torque': torque, 'velocity': velocity}


def methods(drive: str, store: TunedStore | None = None) -> dict[str, Entrant]:
    """Return every method of a comparison by name, with the settings that tuning found.

    CasADi's nonlinear MPC is among them if CasADi is installed.

    Raises
    ------
    StoreError
        A method was not tuned in this drive, what is stored does not fit it any more, or the
        methods were not tuned with equal effort.
    """
    tuned = TunedStore.load(SHIPPED) if store is None else store
    tuned.check_equal()
    found: dict[str, Entrant] = {}
    for each in contestants():
        settings = tuned.applied(each.name, drive, each.start[drive])
        if each.name == FULL:
            found |= _composed(settings)
            continue
        previews = bool(each.rival_type.preview)
        found[each.name] = Entrant(each.name, each.rival_type, settings, True, True, previews)
    for name in ('linear MPC preview', 'CasADi NMPC'):
        if name in found:
            wrong, exact = found[name], f'{name}, exact model'
            settings = wrong.settings.changed({'model_error': 1.0})
            found[exact] = Entrant(exact, wrong.rival_type, settings, True, True, True)
    return found


def _composed(full: Settings) -> dict[str, Entrant]:
    found = {}
    for name, changes in {**STAGES, **WITHOUT}.items():
        settings = full.changed(changes)
        previews = settings.flat()['switches.preview'] is True
        found[name] = Entrant(name, Composed, settings, True, False, previews)
    return found
