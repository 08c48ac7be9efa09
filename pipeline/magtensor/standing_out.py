"""Samples of a calibrated survey that stand out alone: no calibration, no field and no noise makes them.

Another survey may cross any field, so that only the outputs are judged which neither a uniform field nor a gradient
moves. Even there a near source shows, and a range that ends, and an effect nobody knows: but not for one sample and
its neighbour only. Along a gradient, which three sensors in a plane do not tell from a disturbance of one and two
sensors never do, only what is far beyond anything beside it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from magtensor.calibration.joint_together import FALSE_REJECTION, LEAST_FOR_REJECTION
from magtensor.calibration.types import Array, ArrayCalibration, Mask
from magtensor.error_models.waveform import free_directions
from magtensor.in_a_row import in_a_row
from magtensor.survey.flags import flag_ranges
from magtensor.survey.model import Survey
from magtensor.tensor.geometry import array_design

BY = "apply"
REASON = "stands out alone: no calibration and no noise explain it"
LONGEST = 2  # samples: what lasts longer is left to speak for itself
BEND = 0.5  # off field and gradient, over along the gradient: a source three baselines away shows less
WITHOUT_FOOT = (
    50.0  # times what its neighbours differ from theirs: a source three baselines away leaves more there if it
)
# moves by less than seven in a sample
SURROUNDINGS = 101  # samples over which the level of the noise may change


def flagged(
    survey: Survey, calibration: ArrayCalibration, noise: Array | None, *, uniform: bool, longest: int = LONGEST
) -> Survey:
    """A survey with the samples taken out of use that stand out alone.

    Args:
        survey: with `b_raw`, known effects taken off.
        calibration: in the frame of the sensors' positions.
        noise: (S, 3) nT by which the outputs are weighed; all alike where it is not known.
        uniform: the field is known to be uniform, and to have the survey's total field where it has one.
        longest: how many samples may stand out one after the other; more are left to speak for themselves.
    """
    raw, usable = np.asarray(survey.values("b_raw"), dtype=float), survey.good
    usable = usable & np.isfinite(raw).all(axis=(1, 2))
    if noise is None or not np.isfinite(noise).all() or not (noise > 0).all():
        noise = np.ones(raw.shape[1:])
    outputs = (np.nan_to_num(raw) - calibration.offset).reshape(len(raw), -1) / noise.ravel()
    forward = np.asarray(np.linalg.inv(calibration.matrix), dtype=float)
    field = forward.reshape(-1, 3) / noise.reshape(-1, 1)
    parts: list[Array] = []
    gradient: Array | None = None
    if uniform:
        parts.append(outputs @ free_directions(field))
    else:
        gradient = outputs @ (off_field := free_directions(field))
        if (design := _of_gradients(survey, forward)) is not None:
            free = free_directions(design / noise.reshape(-1, 1))
            parts.append(outputs @ free)
            gradient = gradient @ free_directions(off_field.T @ free)
    parts = [p for p in parts if p.shape[1]]
    if uniform and "total_field" in survey:
        total_field = survey.values("total_field")
        usable = usable & np.isfinite(total_field)
        magnitude = np.linalg.norm(calibration.apply(np.nan_to_num(raw)), axis=2)
        parts.append((magnitude.mean(axis=1) - np.nan_to_num(total_field))[:, None])
    if gradient is not None and not gradient.shape[1]:
        gradient = None
    if (gradient is None and not parts) or usable.sum() < LEAST_FOR_REJECTION:
        return survey
    alone = np.zeros(len(raw), dtype=bool)
    seen = None if gradient is None else gradient[usable]
    alone[usable] = standing_out([part[usable] for part in parts], seen, longest)
    return _without(survey, alone)


def _without(survey: Survey, alone: Mask) -> Survey:
    """A survey with samples (N,) taken out of use."""
    if not alone.any():
        return survey
    good = survey.good_by_sensor & ~alone[:, None]
    given = {"good": (("time", "sensor"), good, {"long_name": "may be used"})}
    return survey.merged(given, flag_ranges(survey.time, alone, by=BY, reason=REASON))


def before_and_cleaned(
    survey: Survey, cleaned: Callable[[Survey], Survey], judged: Callable[..., Survey]
) -> tuple[Survey, Survey]:
    """A survey, and the same with known effects taken off, without what stands out whether or not they are.

    What an effect makes of the field beside a spike would be full of it, so error models do not look at samples that
    stand out. But in a quick turn the effect itself may: a sample that does not, when it is taken off by the field that
    is seen there, is a good one.

    Args:
        cleaned: takes the effects off; judged: takes out of use what stands out (`flagged`).
    """
    doubted = judged(survey)
    if not (alone := survey.good & ~doubted.good).any():
        return survey, cleaned(survey)
    wrong = alone & ~judged(cleaned(survey), longest=len(alone)).good
    before = doubted if np.array_equal(wrong, alone) else _without(survey, wrong)
    return before, cleaned(before)


def standing_out(parts: list[Array], gradient: Array | None = None, longest: int = LONGEST) -> Mask:
    """(N,) samples at which any of several residuals (N, K) departs from its neighbours beyond noise, and alone.

    Where the outputs (N, G) that a gradient moves, in the same units, depart by so much more that the bend of a real
    field could be the cause, nothing is taken.

    The level of the noise is that of the whole, or of the surroundings where these are noisier. Of N clean samples none
    is taken with a probability of 0.99.
    """
    count = len(parts[0] if gradient is None else gradient)
    found = _beyond_noise(parts, gradient, np.zeros(count, dtype=bool))
    out = found & _beyond_noise(parts, gradient, found)  # one of the first round may have had such neighbours
    for start, stop in in_a_row(out):
        if stop - start > longest:
            out[start:stop] = False
    return out


def _beyond_noise(parts: list[Array], gradient: Array | None, doubted: Mask) -> Mask:
    """(N,) samples that depart from those before and from those after, to the same side."""
    from scipy.ndimage import median_filter
    from scipy.special import chdtri

    count = len(doubted)
    out = np.zeros(count, dtype=bool)
    for values in parts:
        freedom = values.shape[1]
        limit = chdtri(freedom, FALSE_REJECTION / (count * len(parts))) / chdtri(freedom, 0.5)
        apart = [values - side for side in _beside(values, doubted)]
        scale = np.maximum(np.median(np.abs(apart[0]), axis=0), 1e-300)
        beyond = np.sum(apart[0] * apart[1] / scale**2, axis=1) > 0
        if gradient is not None:
            for each, other in zip(apart, _beside(gradient, doubted), strict=True):
                bend = BEND**2 * np.mean((gradient - other) ** 2, axis=1)
                beyond &= np.mean(each**2, axis=1) > bend
        for each in apart:
            square = np.sum((each / scale) ** 2, axis=1)
            level = np.maximum(np.median(square), median_filter(square, size=SURROUNDINGS, mode="reflect"))
            beyond &= square > limit * level
        out |= beyond
    return out if gradient is None else out | _without_foot(gradient, doubted)


def _without_foot(gradient: Array, doubted: Mask) -> Mask:
    """(N,) samples at which the outputs that a gradient moves (N, G) depart from those before and from those after, to
    the same side, by far more than the nearest of these from the next: no source comes and goes so fast."""
    sides = _two_beside(gradient, doubted)
    apart = [gradient - side.mean(axis=0) for side in sides]
    scale = np.maximum(np.median(np.abs(apart[0]), axis=0), 1e-300)
    foot = np.max([np.linalg.norm((side[0] - side[1]) / scale, axis=1) for side in sides], axis=0)
    least = WITHOUT_FOOT * np.maximum(foot, np.median(foot))
    size = np.min([np.linalg.norm(each / scale, axis=1) for each in apart], axis=0)
    found: Mask = (np.sum(apart[0] * apart[1] / scale**2, axis=1) > 0) & (size > least)
    return found


def _beside(values: Array, doubted: Mask) -> tuple[Array, Array]:
    """(N, K) each: means of the two samples before and of the two after, the doubted ones passed over."""
    before, after = _two_beside(values, doubted)
    return before.mean(axis=0), after.mean(axis=0)


def _two_beside(values: Array, doubted: Mask) -> tuple[Array, Array]:
    """(2, N, K) each: the two samples before and the two after, the nearest first, the doubted ones passed over."""
    believed = np.flatnonzero(~doubted)
    index = np.arange(len(values))
    first, last = np.searchsorted(believed, index), np.searchsorted(believed, index, side="right")
    before = [believed[np.clip(first - k, 0, None)] for k in (1, 2)]
    after = [believed[np.clip(last + k, None, len(believed) - 1)] for k in (0, 1)]
    for k in (0, 1):  # at an end there is one side only
        before[k] = np.where(first - k - 1 < 0, after[k], before[k])
        after[k] = np.where(last + k >= len(believed), before[k], after[k])
    return values[np.stack(before)], values[np.stack(after)]


def _of_gradients(survey: Survey, forward: Array) -> Array | None:
    """(3 S, P) what field and gradient add to the outputs; None where the sensors' places are not known."""
    if "position" not in survey or not np.isfinite(survey.values("position")).all():
        return None
    design = array_design(np.asarray(survey.values("position"), dtype=float), "gradient").reshape(len(forward), 3, -1)
    out: Array = np.einsum("sij,sjk->sik", forward, design).reshape(3 * len(forward), -1)
    return out
