"""Whether what differs between the sensors has the shape of a uniform gradient of the field.

A gradient of the site, or of anything far away, adds G p to a sensor at p. G is symmetric and traceless: of the
3 S - 3 values that a residual has across the plane no more than five directions, whatever G does in time. Noise of the
sensors, slow or not, knows no such directions, and neither do their own errors.
"""

from __future__ import annotations

import numpy as np

from magtensor.calibration.joint import nearest_frame
from magtensor.calibration.types import Array
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.fitting.model import State
from magtensor.loop.fitting.separation import SEPARATION

MODEL = "site_gradient"
MOST_OUTSIDE = 0.1  # of the variance of each of its directions: what any other direction holds at most
LEAST_SECOND = 0.05  # of the strongest direction: a single waveform of any source has but one
CHANCE = 0.01  # that errors of sensors look like it: of three, they have but one direction outside
CLEARLY = 5.0  # times the variance of any other direction, where the noise is not known
BEYOND_CHANCE = 5.0  # standard deviations of the white noise's own variance
MOST = 0.5  # of what is left above the white noise
_RANK = 1e-6


def gradient_share(state: State, position: Array | None) -> float:
    """The part of the residual's variance across, above the white noise, that a uniform gradient makes.

    Parameters
    ----------
    position: (S, 3) m, None where it is not known.

    Returns
    -------
    Within 0 and 1; 0 where the array cannot tell, where one waveform would do, where other directions hold too much,
    or no less than they would by chance.
    Where they hold less than white noise does, a sensor's noise is not what it was taken for, and the share has to be
    clear without it.
    """
    residual = state.residual
    if position is None or residual.across is None:
        return 0.0
    directions = _directions(state, position)
    most, held = len(residual.noise) - 3, directions.shape[1]
    n, spent = residual.affine.shape
    if not 1 < held < most or n <= spent:
        return 0.0
    covariance = residual.across.T @ residual.across / (n - spent)
    white = state.colours.across.white
    inside = np.linalg.eigvalsh(directions.T @ covariance @ directions) - white
    total, of_gradient = float(np.trace(covariance)) - most * white, float(inside.sum())
    each_outside, each_inside = (total - of_gradient) / (most - held), of_gradient / held
    if of_gradient < BEYOND_CHANCE * white * np.sqrt(2.0 * held / n):
        return 0.0
    less = each_outside < -BEYOND_CHANCE * white * np.sqrt(2.0 / (most - held) / n)  # than the noise that was assumed
    if less and each_inside + white < CLEARLY * (each_outside + white):
        return 0.0
    if each_outside > MOST_OUTSIDE * each_inside or inside[-2] < LEAST_SECOND * inside[-1]:
        return 0.0
    excess = min(each_outside, 0.0)  # that the noise was taken for
    outside = (most - held) * (each_outside - excess) + (white + excess) * np.sqrt(2.0 * (most - held) / n)
    strengths = np.maximum(inside - excess, 0.0)
    if _by_chance(outside / (outside + strengths.sum()), strengths, most - held, held) > CHANCE:
        return 0.0
    return min(of_gradient / total, 1.0)


def _by_chance(outside: float, strengths: Array, others: int, held: int) -> float:
    """Probability that waveforms which add to the sensors in any proportion leave no larger a share of their variance
    outside of some directions: that of as many of one strength, each of which has Beta(others / 2, held / 2) there.

    Parameters
    ----------
    outside: the share; strengths: variances of the waveforms; others, held: directions outside and inside.
    """
    from scipy.special import betainc

    waveforms = float(strengths.sum() ** 2 / (strengths @ strengths))
    return float(betainc(waveforms * others / 2.0, waveforms * held / 2.0, outside))


def only_of_a_gradient(state: State, position: Array | None, left: Residual, coefficients: int) -> bool:
    """Whether what was taken off the residual across has the shape of a uniform gradient, as has most of what was
    there, and leaves no less of any other shape than chance would: a part of what a gradient does.

    An error of sensors has other shapes too, and what stands for a gradient brings some in.

    Parameters
    ----------
    left: the residual that it was taken off; coefficients: with so many.
    """
    before = state.residual
    if position is None or before.across is None or gradient_share(state, position) <= MOST:
        return False
    assert left.across is not None
    directions = _directions(state, position)
    whole = float(np.sum(before.across**2) - np.sum(left.across**2))
    inside = float(np.sum((before.across @ directions) ** 2) - np.sum((left.across @ directions) ** 2))
    return whole - inside < SEPARATION + coefficients


def _directions(state: State, position: Array) -> Array:
    """(3 S, K <= 5) orthonormal, what uniform gradients make of a residual across."""
    residual = state.residual
    forward = state.fit.forward @ nearest_frame(state.fit.forward)
    shown = np.einsum("sij,kjl,sl->sik", forward, _symmetric(), position - position.mean(0)).reshape(-1, 5)
    directions, size, _ = np.linalg.svd(residual.projector @ (shown / residual.noise[:, None]), full_matrices=False)
    out: Array = directions[:, size > _RANK * size[0]] if size[0] > 0 else directions[:, :0]
    return out


def _symmetric() -> Array:
    """(5, 3, 3) symmetric matrices without trace."""
    out = np.zeros((5, 3, 3))
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        out[k, i, j] = out[k, j, i] = 1.0
    out[3], out[4] = np.diag([1.0, -1.0, 0.0]), np.diag([1.0, 1.0, -2.0])
    return out
