"""What error models see of a fit: outputs and field as it has them, how noisy they are, the sources of the site."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.by_sensor import by_sensor
from magtensor.calibration.joint import JointFit, nearest_frame
from magtensor.calibration.types import Array
from magtensor.error_models.excitation import Excitation
from magtensor.in_a_row import in_a_row
from magtensor.loop.fitting.model import Adopted, Record, of_the_site

LONGEST = 5  # samples that are disturbed one after the other, over which the field is seen from those beside them
BESIDE = 8  # samples to either side, from which it is
FARTHER = 3.0  # times: a spike of one of two sensors is twice as far from the truth as either is from their mean
_MATTERS = 1e-10  # of the square of the field: noise with less makes no regressor noisy


def excitation_of(
    record: Record, fit: JointFit, raw: Array, lines: Sequence[float] = (), seen: NDArray[np.bool_] | None = None
) -> Excitation:
    """Modelled outputs and field of every sample from the common field of a fit, of the length that is known: the noise
    in what is seen of it is what the total field's residual is made of, and models would find it there.

    Parameters
    ----------
    raw: (N, S, 3) nT, that the fit was made from: a strong effect on one sensor would else be in the common field.
    seen: (N,) samples in whose field models may look; those that the fit believes if None.
    """
    believed = np.asarray(fit.keep) if seen is None else seen
    b = fit.scalar.field(fit.plane.coordinates(raw)) if fit.posterior is None else fit.posterior.field
    if not believed.all():
        off = spread(by_sensor(np.linalg.inv(fit.forward), raw - fit.offset))
        if off is not None and record.total_field is not None:
            off = np.maximum(off, np.abs(np.linalg.norm(b, axis=1) - record.total_field))
        b = over_disturbances(b, believed, record.time, record.run, off)
    b = of_known_length(b, record.total_field)
    q = nearest_frame(fit.forward)

    def outputs_and_fields(b: Array) -> tuple[Array, Array]:
        return by_sensor(fit.forward, b) + fit.offset, np.repeat((b @ q)[:, None], len(record.sensors), axis=1)

    again, noise = None, fit.scalar.matrix  # of outputs divided by theirs
    if fit.posterior is None and np.mean(noise**2) > _MATTERS * np.mean(b**2):
        more = np.random.default_rng(0).normal(size=b.shape) @ noise.T
        again = outputs_and_fields(of_known_length(b + more, record.total_field))
    return record.excitation(*outputs_and_fields(b), lines, matrix=fit.forward @ q, again=again)


def spread(fields: Array) -> Array | None:
    """(N,) nT, how far the farthest of several sensors is from their mean, of fields (N, S, 3); None of one sensor."""
    if fields.shape[1] == 1:
        return None
    return np.asarray(np.linalg.norm(fields - fields.mean(axis=1, keepdims=True), axis=2).max(axis=1))


def over_disturbances(
    b: Array, keep: NDArray[np.bool_], time: Array, run: NDArray[np.int_], off: Array | None = None
) -> Array:
    """Fields (N, ...) nT without what disturbed single samples: a spike of one sensor is in the field that all are
    thought to see, and a rate of change or what remembers the field would have it for some time.

    Where the field turns fast between samples those beside a sample tell less of it than itself, disturbed or not: an
    effect that follows the turning is flagged there above all, before it has a name.

    Parameters
    ----------
    keep: (N,) samples that the fit believes; time: (N,) s; run: (N,) number of the contiguous run.
    off: (N,) nT, by how much sensors are off from each other, or from a known length: what is farther from a sample
        than `FARTHER` times that is no better; None where nothing tells.
    """
    starts, stops = in_a_row(~keep).T
    short = (stops - starts <= LONGEST) & (starts >= BESIDE) & (stops + BESIDE <= len(keep))
    starts, stops = starts[short], stops[short]
    inside = run[np.maximum(starts - BESIDE, 0)] == run[np.minimum(stops + BESIDE, len(run)) - 1]
    disturbed, near = np.zeros((2, len(keep)), dtype=bool)
    for first, stop in zip(starts[inside], stops[inside], strict=True):
        disturbed[first:stop] = True
        near[first - BESIDE : stop + BESIDE] = True
    near &= keep
    if not disturbed.any() or near.sum() < BESIDE:
        return b
    from scipy.interpolate import CubicSpline

    guess = CubicSpline(time[near], b[near])(time[disturbed])
    if off is not None:
        far = np.abs(guess - b[disturbed]).reshape(len(guess), -1).max(axis=1)
        worse = far > FARTHER * off[disturbed]
        # what is next to a sample that is seen better by itself was flagged with it
        worse = np.isin(_stretch(disturbed), _stretch(disturbed)[worse])
        guess[worse] = b[disturbed][worse]
    out = b.copy()
    out[disturbed] = guess
    return out


def _stretch(flags: NDArray[np.bool_]) -> NDArray[np.int_]:
    """For each flagged sample the number of its stretch of them."""
    return np.asarray(np.cumsum(np.diff(flags.astype(int), prepend=0) > 0)[flags])


def of_known_length(b: Array, total_field: Array | None) -> Array:
    """Fields (N, 3) nT of the length (N,) nT that is known."""
    return b if total_field is None else b * (total_field / np.linalg.norm(b, axis=1))[:, None]


def beside_the_site(x: Excitation, adopted: Sequence[Adopted], theta: Sequence[Array]) -> Excitation:
    """What error models see beside those of the site that are adopted: the field of these at each sensor, too.

    Only of sources that are fixed in the world: their field is another one at each sensor, and turns with the attitude.
    """
    count, sensors = len(x.time), len(x.sensors)
    site = np.zeros((count, 3 * sensors))
    for model, coefficients in zip(adopted, theta, strict=True):
        if of_the_site(model.component) and np.any(coefficients):
            terms = model.terms(x)
            if terms.count == len(coefficients):  # a fit may begin from those of other settings
                site += terms.contribution(coefficients, 3 * sensors)
    if not site.any():
        return x
    seen = replace(x, site=by_sensor(np.linalg.inv(x.matrix), site.reshape(count, sensors, 3)))
    vars(seen)["matrix"] = x.matrix
    return seen
