# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""PI control, active disturbance rejection, and the jump transient that all feedback baselines share."""

from dataclasses import dataclass
import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.baselines.baseline_controller import (
    BaselineController,
    NominalModel,
    Observation,
)
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, group, parameter

Array = NDArray[np.float64]
Table = TypeVar('Table', bound=Parameters)

# Rows of a rival's memory, shape (n, 2); what a method needs of its own comes after them.
TRANSIENT, CLOSING, REQUESTED, APPLIED, PREDICTED_REFERENCE, OWN = range(6)


@dataclass(frozen=True)
class CrossingParameters(Parameters):
    """How the known part of the error, h, is closed after a jump of the reference."""

    rate: float = parameter(
        100.0,
        'rate at which the error closes that a jump of the reference or a limit has made',
        unit='1/s',
        low=1.0,
        high=500.0,
    )
    acceleration: float = parameter(
        200.0,
        'largest acceleration asked for it; torques are not told when they are cut, so that with '
        'a torque drive this should be what the motors can do',
        unit='rad/s²',
        low=1.0,
        high=1000.0,
    )


@kernel
def disturbance_error(
    wheel: int,
    speeds: Array,
    wanted: Array,
    period: float,
    input_gain: float,
    share: float,
    acceleration: float,
    memory: Array,
) -> float:
    """Return e (rad/s), the error that neither jumps nor limits explain; renew h and v(h).

    speeds, wanted : shape (2,), chi and r, rad/s
    period : T, s
    input_gain : acceleration per unit of u, 1
    share : 1 - exp(-rate T), so that h never overshoots zero however large the rate
    acceleration : largest |v|, rad/s²
    memory : shape (n, 2); an EXPECTED that is not a number means the first step, at which all of
        the error is h: the wheels start from where they are
    """
    error = speeds[wheel] - wanted[wheel]
    expected = memory[PREDICTED_REFERENCE, wheel]
    if math.isnan(expected):
        known = error
    else:
        deficit = memory[APPLIED, wheel] - memory[REQUESTED, wheel]
        push = memory[CLOSING, wheel] + input_gain * deficit
        known = memory[TRANSIENT, wheel] + period * push - (wanted[wheel] - expected)
    memory[TRANSIENT, wheel] = known
    closing = -share * known / period
    memory[CLOSING, wheel] = min(max(closing, -acceleration), acceleration)
    return float(error - known)


@kernel
def write_acceleration(
    wheel: int, u: float, wanted_next: Array, memory: Array, command: Array
) -> None:
    """Write u (rad/s²) of one wheel, and keep what the next :func:`trace` needs.

    Until the drive says otherwise, all of u is applied.
    """
    memory[REQUESTED, wheel] = u
    memory[APPLIED, wheel] = u
    memory[PREDICTED_REFERENCE, wheel] = wanted_next[wheel]
    command[wheel] = u


def checked_parameters(parameters: Parameters, kind: type[Table]) -> Table:
    """Return ``settings``, of which a rival is sure from then on that they are its own.

    Raises
    ------
    ValueError
        They are another method's.
    """
    if not isinstance(parameters, kind):
        raise ValueError(f'settings must be {kind.__name__}: got {type(parameters).__name__}')
    return parameters


class FeedbackBaseline(BaselineController):
    """Base of rivals that tell the effect of disturbances from that of jumps and limits.

    Parameters
    ----------
    knowledge
        What is known of the robot.
    crossing
        How h is closed.
    own
        How many rows of memory the method needs for itself.
    """

    def __init__(
        self, nominal_model: NominalModel, crossing: CrossingParameters, own: int
    ) -> None:
        self._period = nominal_model.period
        self._memory: Array = np.zeros((OWN + own, 2))
        self._memory[PREDICTED_REFERENCE] = math.nan
        self._command: Array = np.zeros(2)
        self._closing = (
            1.0 - math.exp(-crossing.rate * nominal_model.period),
            crossing.acceleration,
        )

    @property
    def transient(self) -> Array:
        """h, the part of the error that jumps and limits explain, rad/s, shape (2,)."""
        transient: Array = self._memory[TRANSIENT].copy()
        return transient

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Take note of the u that the drive's limits let through: the rest goes into h."""
        self._memory[APPLIED] = acceleration


@dataclass(frozen=True)
class ProportionalIntegralParameters(Parameters):
    """Gains of the PI controller."""

    gain: float = parameter(
        30.0, 'proportional gain K on the error', unit='1/s', low=0.5, high=100.0
    )
    integral: float = parameter(
        200.0,
        'integral gain; K²/4 is critical damping in continuous time',
        unit='1/s²',
        low=0.1,
        high=5000.0,
    )
    crossing: CrossingParameters = group(CrossingParameters)


@kernel
def _integrate(
    speeds: Array,
    wanted: Array,
    wanted_next: Array,
    period: float,
    gains: Array,
    memory: Array,
    command: Array,
) -> None:
    """Write the PI's answer. gains : K (1/s), K_i (1/s²), closing share and acceleration."""
    for i in range(2):
        error = disturbance_error(i, speeds, wanted, period, 1.0, gains[2], gains[3], memory)
        memory[OWN, i] += period * gains[1] * error
        feedforward = (wanted_next[i] - wanted[i]) / period + memory[CLOSING, i]
        u = feedforward - gains[0] * error - memory[OWN, i]
        write_acceleration(i, u, wanted_next, memory, command)


class ProportionalIntegral(FeedbackBaseline):
    r"""PI with feed-forward: u = r' + v(h) - K e - I, I_k = I_(k-1) + T K_i e_k.

    The feedback sees e alone, whose poles are the roots of

    .. math:: z^2 - (2 - KT - K_iT^2)\,z + (1 - KT) = 0,

    whatever jumps and limits do (two degrees of freedom, Åström and Hägglund 2006). A constant
    disturbance leaves no error.
    """

    parameters_type = ProportionalIntegralParameters

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        table = checked_parameters(parameters, ProportionalIntegralParameters)
        super().__init__(nominal_model, table.crossing, own=1)
        self._gains: Array = np.array([table.gain, table.integral, *self._closing])

    @property
    def integral(self) -> Array:
        """I, what the controller opposes to the disturbance, rad/s², shape (2,)."""
        integral: Array = self._memory[OWN].copy()
        return integral

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        _integrate(
            observation.speeds,
            observation.wanted,
            observation.wanted_next,
            self._period,
            self._gains,
            self._memory,
            self._command,
        )
        return self._command


@dataclass(frozen=True)
class DisturbanceRejectionParameters(Parameters):
    """Gains of active disturbance rejection."""

    gain: float = parameter(
        30.0, 'bandwidth of the controller, k', unit='1/s', low=0.5, high=100.0
    )
    observer_bandwidth: float = parameter(
        30.0,
        'bandwidth of the extended state observer, omega_o: both poles at exp(-omega_o T)',
        unit='1/s',
        low=0.5,
        high=300.0,
    )
    input_gain: float = parameter(
        1.0, 'what an acceleration that is asked for brings about, b_0', low=0.3, high=3.0
    )
    shared_disturbance: float = parameter(
        0.0,
        "share of the filter's unexplained acceleration, common to all methods, in what is "
        "cancelled; the rest is the observer's own",
        low=0.0,
        high=1.0,
    )
    shared_speed: float = parameter(
        0.0,
        "share of the filter's speed in the feedback; the rest is the observer's own",
        low=0.0,
        high=1.0,
    )
    crossing: CrossingParameters = group(CrossingParameters)


_SPEED, _DISTURBANCE = OWN, OWN + 1


@kernel
def _reject(
    speeds: Array,
    unexplained: Array,
    wanted: Array,
    wanted_next: Array,
    period: float,
    gains: Array,
    memory: Array,
    command: Array,
) -> None:
    """Write the answer of disturbance rejection, after an observer step.

    gains : k (1/s), l_1 (1), l_2 (1/s), b_0, shares of disturbance and speed, closing share and
        acceleration
    """
    input_gain, share, mix = gains[3], gains[4], gains[5]
    for i in range(2):
        if math.isnan(memory[PREDICTED_REFERENCE, i]):
            memory[_SPEED, i] = speeds[i]
        else:
            push = input_gain * memory[APPLIED, i] + memory[_DISTURBANCE, i]
            memory[_SPEED, i] += period * push
            surprise = speeds[i] - memory[_SPEED, i]
            memory[_SPEED, i] += gains[1] * surprise
            memory[_DISTURBANCE, i] += gains[2] * surprise
        error = disturbance_error(
            i, speeds, wanted, period, input_gain, gains[6], gains[7], memory
        )
        error += (1.0 - mix) * (memory[_SPEED, i] - speeds[i])
        load = memory[_DISTURBANCE, i]
        load += share * (unexplained[i] - load)
        feedforward = (wanted_next[i] - wanted[i]) / period + memory[CLOSING, i]
        u = (feedforward - gains[0] * error - load) / input_gain
        write_acceleration(i, u, wanted_next, memory, command)


def observer_gains(bandwidth: float, period: float) -> tuple[float, float]:
    r"""Return (l_1, l_2), in 1 and 1/s, that put both observer poles at beta = exp(-omega_o T).

    Prediction with the model, then correction by L times the surprise, makes the error of the
    estimate follow (I - L C) A with A = [[1, T], [0, 1]], whose trace is 2 - l_1 - l_2 T and
    whose determinant is 1 - l_1; hence l_1 = 1 - beta² and l_2 = (1 - beta)²/T
    (Miklosovic, Radke and Gao 2006).
    """
    beta = math.exp(-bandwidth * period)
    return 1.0 - beta**2, (1.0 - beta) ** 2 / period


class DisturbanceRejection(FeedbackBaseline):
    """Active disturbance rejection: u = (r' + v(h) - k e - f)/b_0 (Han 2009).

    All that is not b_0 u is one number f, which an extended state observer of
    chi' = b_0 u + f estimates from the speed and from the u that was really applied, so that it
    cannot wind up. Both observer poles are at one place (Gao 2003). v(h) is Han's arranged
    transient. doi 10.1109/TIE.2008.2011621.
    """

    parameters_type = DisturbanceRejectionParameters

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        table = checked_parameters(parameters, DisturbanceRejectionParameters)
        super().__init__(nominal_model, table.crossing, own=2)
        self._gains: Array = np.array(
            [
                table.gain,
                *observer_gains(table.observer_bandwidth, nominal_model.period),
                table.input_gain,
                table.shared_disturbance,
                table.shared_speed,
                *self._closing,
            ]
        )

    @property
    def observed(self) -> Array:
        """The observer's own chi (rad/s) and f (rad/s²), shape (2, 2), a wheel a column."""
        observed: Array = self._memory[OWN:].copy()
        return observed

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        _reject(
            observation.speeds,
            observation.unexplained,
            observation.wanted,
            observation.wanted_next,
            self._period,
            self._gains,
            self._memory,
            self._command,
        )
        return self._command
