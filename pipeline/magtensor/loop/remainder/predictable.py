"""What of a residual can be predicted from the attitude, whatever the law."""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.acting import AXES
from magtensor.error_models.direction import attitude_series, curve_series, direction_series, turning_series
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.terms import Terms, joined
from magtensor.loop.evidence.assessment import WHITE, Colours
from magtensor.loop.evidence.folds import FOLDS, block_count
from magtensor.loop.evidence.gains import Gain, held_out_gain
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.fitting.model import State

LEAST_T = 4.5  # one in a thousand by chance: paired t over folds of what the direction predicts
LEAST_T_OF_EACH = 6.5  # the same for each of a dozen outputs
LEAST_IN_CLASS = 20  # samples that read much the same
LEAST_CLASSES, MOST_CLASSES = 16, 64
MOSTLY = 0.9  # of what outputs of their own explain: if the total field alone does that, it is the total field
MOST_OF_IT = 0.5  # of what an effect adds: so much of it, predicted from the attitude, follows the attitude
ROUNDING = 1e-6  # of the largest singular value
LEAST_FOR_DIRECTION = 60  # samples for each output, at least, before its own polynomial can be asked for


def attitude_words(state: State) -> list[str]:
    """What of the residual the attitude predicts: in the outputs, or in the total field alone where that does."""
    turning, moving = predictable_from_direction(state), predictable_in_the_total_field(state)
    if moving > 0 and moving > MOSTLY * turning:
        spread = np.sqrt(state.residual.freedom * np.mean(state.residual.reference_gain**-2.0))  # nT, of |b| - F
        return [
            f"{moving * spread:.3g} nT rms of |b| - F, in all sensors alike, can be predicted from the attitude: the "
            "field may change as the array moves"
        ]
    amount = turning * state.residual.scale
    words = f"{amount:.3g} nT rms of it can be predicted from the direction of the field and how it turns"
    return [words] if turning > 0 else []


def predictable_from_direction(state: State) -> float:
    """The part of the whitened residual, rms, that follows the field's direction and its rate of change; 0 if none.

    Any smooth effect of attitude, named or not, is a polynomial of the direction to first order: second and third
    degree, the rate of change and, for what has a memory, the way of the turning alone, with coefficients of every
    output's own, are fitted on some blocks and judged on others. Noise makes such a model worse than none.
    """
    if len(state.residual.affine) < LEAST_FOR_DIRECTION * 3 * len(state.excitation.sensors):
        return 0.0
    return _predictable(state, _direction_terms(state.excitation))


def predictable_in_the_total_field(state: State) -> float:
    """The part of the whitened residual, rms, that the attitude predicts as a change of the total field; 0 if none.

    The same for what no sensor feels alone: polynomials of the direction, and of attitudes and accelerations where they
    are logged, added to the reference.
    """
    if state.residual.along is None or not enough_for_the_total_field(state):
        return 0.0
    series = attitude_series(state.excitation)
    each = [state.excitation.on_reference(column, "nT", str(number)) for number, column in enumerate(series.T)]
    return _predictable(state, joined(each))


def enough_for_the_total_field(state: State) -> bool:
    """Whether there are samples enough to ask what of the total field the attitude predicts."""
    return len(state.residual.affine) >= LEAST_FOR_DIRECTION * attitude_series(state.excitation).shape[1]


def attitude_part(state: State, added: Array) -> float:
    """How much of the variance of series (N, 3 S) nT that are added to the outputs at the residual's samples can be
    predicted from the attitude, whatever the law."""
    residual = state.residual
    series = attitude_series(state.excitation)[residual.samples]
    own = residual.free_across
    added, series = (x - own @ (own.T @ x) for x in (added / residual.noise, series))
    follows = np.linalg.lstsq(series, added, rcond=None)[0]
    total = float(np.sum(added**2))
    return 1.0 - float(np.sum((added - series @ follows) ** 2)) / total if total > 0 else 0.0


def attitude_square(state: State, left: Residual) -> float:
    """Sum of squares of what laws of the attitude, and any curve of the field along each axis, predict of a residual
    across, at the state's samples, on contiguous folds that they were not fitted to: noise, slow or not, is no part of
    it."""
    assert left.across is not None
    x, residual = state.excitation, state.residual
    series = np.hstack([made(x)[residual.samples] for made in (attitude_series, curve_series)])
    own = residual.free_across
    basis, size, _ = np.linalg.svd(series - own @ (own.T @ series), full_matrices=False)
    basis, values = basis[:, size > ROUNDING * size[0]], left.across
    total, predicted = basis.T @ values, 0.0
    for part in np.array_split(np.arange(len(values)), FOLDS):
        known = np.eye(basis.shape[1]) - basis[part].T @ basis[part]  # of the other folds
        theta = np.linalg.lstsq(known, total - basis[part].T @ values[part], rcond=ROUNDING)[0]
        predicted += float(np.sum(values[part] ** 2) - np.sum((values[part] - basis[part] @ theta) ** 2))
    return max(predicted, 0.0)


def converter_words(state: State) -> list[str]:
    """Which outputs depart by an amount that follows from what they read, as those of a converter that is not linear
    do: steps and waves that no polynomial is."""
    amounts = by_what_they_read(state)
    if not (amounts > 0).any():
        return []
    sensors = zip(state.excitation.sensors, amounts, strict=True)
    each = [(name, " ".join(AXES[k] for k in np.flatnonzero(own))) for name, own in sensors]
    names = ", ".join(f"{name} ({axes})" for name, axes in each if axes)
    return [
        f"what {names} add follows from what they read, by {amounts.max():.2g} nT rms at most, predicted on held-out "
        "blocks, as a converter that is not linear would make it"
    ]


def by_what_they_read(state: State) -> Array:
    """By how much each axis of each sensor (S, 3) departs in a way that follows from what it reads, nT rms; 0 where
    that predicts nothing on held-out blocks."""
    residual, x = state.residual, state.excitation
    amounts = np.zeros((len(x.sensors), 3))
    for number, column in enumerate(() if residual.across is None else residual.across.T):
        sensor, axis = divmod(number, 3)
        reads = x.output[residual.samples, sensor, axis]
        amounts[sensor, axis] = _of_what_it_reads(reads, column) * residual.noise[number]
    return amounts


def _of_what_it_reads(readings: Array, values: Array) -> float:
    """The rms of values (N,) that the mean of those with readings (N,) nearby predicts on contiguous blocks; 0 if none.

    The mean of every class of readings is shrunk towards zero by as much as its own noise asks for.
    """
    count = min(len(readings) // LEAST_IN_CLASS, MOST_CLASSES)
    if count < LEAST_CLASSES or not np.ptp(readings) > 0:
        return 0.0
    number = ((readings - readings.min()) / np.ptp(readings) * count).astype(int).clip(0, count - 1)
    fold = np.arange(len(values)) * FOLDS // len(values)
    before, after = np.zeros(FOLDS), np.zeros(FOLDS)
    for k in range(FOLDS):
        test = fold == k
        size = np.bincount(number[~test], minlength=count)
        total = np.bincount(number[~test], values[~test], minlength=count)
        mean = total / np.maximum(size, 1)
        spread = float(np.var(values[~test]))
        own = max(float(np.average(mean**2, weights=size)) - spread * count / max(size.sum(), 1), 0.0)
        mean *= own * size / np.maximum(own * size + spread, 1e-300)
        before[k] = np.sum(values[test] ** 2)
        after[k] = np.sum((values[test] - mean[number[test]]) ** 2)
    gain = Gain(before, after, np.bincount(fold, minlength=FOLDS).astype(float))
    return float(np.sqrt(max(gain.total, 0.0) / len(values))) if gain.t > LEAST_T_OF_EACH else 0.0


def shortened_words(state: State) -> list[str]:
    """What of |b| - F follows the square of the rate at which the field turns in the sensors' frame, as it does where
    an output is the mean over some time.

    The mean of a vector that turns is shorter: over T by |db/dt|^2 T^2 / (24 F) (Taylor). Rows interpolated between
    two readings, and the filters of a recorder, do the same.
    """
    x, residual = state.excitation, state.residual
    rate = x.rate if x.rate.ndim == 2 else x.rate.mean(axis=1)
    series = np.sum(rate**2, axis=1) / np.linalg.norm(x.field[:, 0], axis=1)
    if residual.along is None or not np.ptp(series) > 0:
        return []
    part = _predictable(state, x.on_reference(series, "s2", "rate"))
    if part == 0.0:
        return []
    seen = series[residual.samples] - series[residual.samples].mean()
    slope = float(seen @ (residual.along / -residual.reference_gain) / (seen @ seen))
    if slope >= 0:
        return []
    amount = -slope * float(seen.std())
    return [
        f"{amount:.3g} nT rms of |b| - F, in all sensors alike, follows the square of the rate at which the field "
        f"turns, as if every row were the mean over {np.sqrt(-24.0 * slope):.2g} s: rows that are averaged, "
        "interpolated or low-passed shorten the field"
    ]


def _predictable(state: State, terms: Terms) -> float:
    """The part of the whitened residual, rms over all its values, that terms at all samples predict on blocks that they
    were not fitted to; 0 if none."""
    from magtensor.loop.evidence.grams import grams

    residual = state.residual
    terms = terms.at(residual.samples)
    given = 0
    if state.terms is not None:
        given = state.terms.count
        terms = joined([state.terms, terms])
    blocked = np.arange(terms.count) < given

    def gain_in(colours: Colours) -> Gain:
        blocks = grams(residual, terms, colours.across, colours.along, block_count(len(residual.affine)))
        return held_out_gain(blocks, residual.freedom, blocked)

    gain = gain_in(state.colours)
    if gain.total <= 0 or gain.t < LEAST_T:
        return 0.0
    before, after = gain_in(WHITE).rms  # seen through the filter the amount would be too small
    return float(np.sqrt(max(before**2 - after**2, 0.0)))


def _direction_terms(x: Excitation) -> Terms:
    """Every output's own coefficients of monomials of the field's direction, of its rate of change and of its way."""
    series = np.hstack([direction_series(x), turning_series(x)])
    outputs, k = 3 * len(x.sensors), series.shape[1]
    part_output, part_series = np.repeat(np.arange(outputs), k), np.tile(np.arange(k), outputs)
    return Terms(
        tuple(f"direction {s}" for s in part_series),
        tuple(x.sensors[o // 3] for o in part_output),
        ("nT",) * (outputs * k),
        series,
        np.arange(outputs * k),
        part_output,
        part_series,
    )
