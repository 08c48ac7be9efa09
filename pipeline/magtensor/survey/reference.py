"""The scalar reference at the array's times: gaps, ends, spikes, uncertainty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.between_readings import Course, course, noise_gain, without_a_gap
from magtensor.survey.recorded_numbers import resolution

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

ENDS = 4  # samples whose line a record goes on along: of two it would be mostly their noise
SPIKE_WINDOW = 7  # samples; three good neighbours on each side outvote a spike of up to three samples
SPIKE_ALONE = 0.7  # of its deviation from the cubic: both are the spike's height, and half a step's from the cubic
LEFT_BESIDE = 0.25  # of its deviation from the cubic: a lone spike leaves nothing at its neighbours, a step a third
CUBIC = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6.0  # what the middle one of five leaves the cubic of the others by
SPIKE_ROUNDS = 4  # in which spikes are looked for, the ones found taken out
SPIKE_SURROUNDINGS = 61  # samples that tell what is usual where the field is active


@dataclass(frozen=True)
class Sampled:
    """A record at other times.

    Attributes:
        values: (M,) NaN where the record does not cover.
        covered: (M,).
        weight_norm: (M,) by how much independent noise of the record's samples is scaled at each time.
    """

    values: Floats
    covered: Bools
    weight_norm: Floats


def sample(at: Floats, time: Floats, values: Floats, *, how: Course, max_gap_s: float) -> Sampled:
    """A record at other times, but for a spline never above or below the two samples between which a time lies.

    Within one median step of an end it goes on along the line through its last samples: where the field moves fast and
    the readings are far apart, the last one held would be wrong by what it moves in a step.

    Args:
        at: (M,) s.
        time: (N,) s, strictly increasing, N >= 1.
        values: (N,) finite.
        how: what goes on between its samples.
        max_gap_s: a longer step of the record is a gap, and so is everything beyond its ends by more than one
            median step.
    """
    if len(time) == 1:
        covered = np.abs(at - time[0]) <= max_gap_s
        return Sampled(np.where(covered, values[0], np.nan), covered, np.ones(len(at)))
    steps = np.diff(time)
    edge = min(float(np.median(steps)), max_gap_s)
    inside = np.clip(at, time[0], time[-1])
    right = np.clip(np.searchsorted(time, inside, side="right"), 1, len(time) - 1)
    step = steps[right - 1]
    weight = (inside - time[right - 1]) / step
    on_sample = (weight == 0.0) | (weight == 1.0)
    covered = (np.abs(at - inside) <= edge) & ((step <= max_gap_s) | on_sample)
    found = course(time, values, how)(inside)
    if how != "spline":  # the last bit of rounding may overshoot
        found = np.clip(
            found, np.minimum(values[right - 1], values[right]), np.maximum(values[right - 1], values[right])
        )
    found = np.where(weight == 1.0, values[right], np.where(weight == 0.0, values[right - 1], found))
    norm = noise_gain(how, weight)
    for out, end in ((at < time[0], slice(None, ENDS)), (at > time[-1], slice(-ENDS, None))):
        beyond, own = (at - inside)[out], time[end] - time[end].mean()
        slope = own / np.sum(own**2)  # as a sum of the samples: a line of least squares
        found[out] += beyond * float(slope @ values[end])
        last = 0 if end.start is None else -1
        norm[out] = np.sqrt(1.0 + 2.0 * beyond * slope[last] + beyond**2 * float(slope @ slope))
    return Sampled(np.where(covered, found, np.nan), covered, norm)


def spikes(values: Floats, threshold: float, time: Floats | None = None) -> Bools:
    """(N,) True where a sample leaves the cubic through its neighbours by more than `threshold` robust standard
    deviations, and is a spike and no step: either its neighbours would lie on their cubics if it lay on its own, or it
    leaves the running median as well, as up to three samples beside each other do.

    The cubic tells a spike from a pulsation; the neighbours and the median tell it from a step, and the neighbours do
    so where the record is steep. Each deviation's scale is 1.4826 times its median magnitude over the whole record, or
    what the upper quartile of the magnitudes around the sample would be the scale of, if that is larger; and at least
    the record's resolution: a proton magnetometer that rounds to 0.1 nT repeats itself for long. The scale from the
    cubic is that of the record without the samples that look like lone spikes in the quiet part of it, and where spikes
    are found it is asked once more without them: some of them make a quiet record seem active around them. Samples on
    the two sides of a gap are no neighbours. The last two before one, and of the record, are spikes by the
    median alone: a steep record may end there.

    Args:
        values: (N,) finite.
        threshold: standard deviations.
        time: (N,) s, which tells gaps; None: there are none.
    """
    least, found = resolution(values), np.zeros(len(values), dtype=bool)
    pieces = [slice(0, len(values))] if time is None else without_a_gap(time)
    for _ in range(SPIKE_ROUNDS):
        without = np.concatenate([_bridged(values[p], found[p]) for p in pieces])
        more = _spikes_among(without, pieces, threshold, least) & ~found
        if not more.any() or (found | more).all():
            break
        found |= more
    return found


def _bridged(values: Floats, bad: Bools) -> Floats:
    """(N,) values without those that are bad, straight from good to good."""
    if not bad.any() or bad.all():
        return values
    place = np.arange(len(values))
    out: Floats = np.interp(place, place[~bad], values[~bad])
    return out


def _spikes_among(values: Floats, pieces: list[slice], threshold: float, least: float) -> Bools:
    """(N,) those that stand out as they are, `least` being the record's resolution."""
    from scipy.ndimage import median_filter

    def by_piece(what: Callable[[Floats], Floats], of: Floats) -> Floats:
        return np.concatenate([what(of[p]) for p in pieces])

    strays = by_piece(_strays, values)
    rough = np.abs(strays)
    lone = by_piece(_left_beside, strays) < LEFT_BESIDE * rough
    # each makes four others stray: where one sample in twenty is a spike a quarter of all do, and would hide them
    suspects = lone & (rough > threshold * max(1.4826 * float(np.median(rough)), least))
    usual = np.concatenate([_bridged(values[p], suspects[p]) for p in pieces])
    limit = threshold * _scale(np.abs(by_piece(_strays, usual)), least)
    astray = rough > limit
    alone = astray & lone
    off = np.abs(values - by_piece(lambda v: median_filter(v, SPIKE_WINDOW, mode="nearest"), values))
    limit = threshold * _scale(off, least)
    several = astray & (off > limit) & (off > SPIKE_ALONE * rough)
    # Beside a spike the running median steps aside on a steep record; what lies on the line between good neighbours
    # is good.
    for piece in pieces:
        some = several[piece]
        several[piece] &= np.abs(values[piece] - _bridged(values[piece], some)) > limit[piece]
    return alone | several


def _strays(values: Floats) -> Floats:
    """(N,) by how much each leaves the cubic through the two on either side; of the first and the last two what the one
    beside them does, which they have a share in; 0 of fewer than five."""
    if len(values) < len(CUBIC):
        return np.zeros(len(values))
    out: Floats = np.pad(np.convolve(values, CUBIC, mode="valid"), 2)
    fourth = out * CUBIC[0]
    out[:2], out[-2:] = fourth[2], fourth[-3]
    return out


def _left_beside(strays: Floats) -> Floats:
    """(N,) the largest of the deviations from the cubic (N,) of the two neighbours on each side, if the sample itself
    lay on it: those beside a spike come from it alone. Of the first and the last two it is not known."""
    n = len(strays)
    out = np.full(n, np.inf)
    padded = np.pad(strays[2:-2], 4, constant_values=np.nan)
    each = [
        padded[2 + k : 2 + k + n] + share * strays for k, share in ((-2, -1 / 6), (-1, 2 / 3), (1, 2 / 3), (2, -1 / 6))
    ]
    if n > len(CUBIC):
        out[2:-2] = np.nanmax(np.abs(each), axis=0)[2:-2]
    return out


def _scale(deviation: Floats, least: float) -> Floats:
    """(N,) standard deviation that magnitudes (N,) show, over all of them or around each, the larger one."""
    from scipy.ndimage import percentile_filter

    around = percentile_filter(deviation, 75, SPIKE_SURROUNDINGS, mode="mirror") / 1.1503  # of a Gaussian
    found: Floats = np.maximum(np.maximum(around, 1.4826 * np.median(deviation)), least)
    return found


def noise(values: Floats) -> float:
    """Standard deviation of one sample, from second differences and the resolution; an upper bound where it curves.

    Args:
        values: (N,) nT.
    """
    step = resolution(values)
    if len(values) < 3:
        return step / np.sqrt(12.0)
    second = np.diff(values, 2)
    return float(np.hypot(1.4826 * np.median(np.abs(second)) / np.sqrt(6.0), step / np.sqrt(12.0)))
