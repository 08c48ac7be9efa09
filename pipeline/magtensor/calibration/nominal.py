"""The joint fit where the attitudes determine no calibration: sensors taken near nominal, by a stated prior.

Outputs come with nominal sensitivity applied, so C is near the identity and o within some range, before any data. In
level flight that is most of what is known: the field turns about one axis, and whole combinations of C and o leave the
outputs as they are. As pseudo-observations in the normal equations the prior gives them their nominal values and keeps
its own variance for them; nothing is inverted that is singular. The likelihood is that of the joint fit (`joint`):
the residual across the plane that the sensors share, and |b| - F along the field.

Two things differ from the fit without a prior. The plane is that of C itself and not of the outputs' principal axes, of
which the third is weaker here than a strong disturbance of one sensor. And a misfit counts as noise, with its
correlation in time: samples are believed only as far as what no model explains yet lets them, or the combinations
that the attitudes show faintly would run after it.

Parameters: output after output the row of C and the offset in units of the mean total field, 12 a sensor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from magtensor.errors import DataError, NotEnoughData

from .agreement import require_agreement
from .by_sensor import by_sensor
from .common_field import CommonField
from .coverage import WORST_ERROR, Coverage, coverage
from .joint import JointFit, Posterior, nearest_frame
from .joint_covariance import frame_projection
from .joint_together import Found, Together, limits_of
from .maximum_likelihood import NOTHING, ScalarFit, along
from .noise import noise_std, second_difference_std
from .nominal_steps import ASTRAY, DIVERGES, HINT, Here, NominalData, settled, settled_slowly, weights_of
from .scalar import checked_samples
from .types import Array, Mask

LEAST_SAMPLES = 50
QUIETEST = 1e-7  # of F: no sensor is believed to be better
FARTHEST = 5.0  # standard deviations of the prior
LARGEST = 100.0  # of F: of outputs that an effect which ran away has been taken off
LOUDEST = 3.0  # times what outputs differ by from sample to sample: more noise they hold in no calibration
_ROUNDS = 8


@dataclass(frozen=True)
class Nominal:
    """What is known of sensors beforehand, one standard deviation each.

    Attributes:
        scale: of a scale factor, relative: its tolerance and the soft iron of the platform.
        angle_deg: of the direction of an axis.
        offset: of an offset, relative to the total field.
    """

    scale: float = 0.1
    angle_deg: float = 6.0
    offset: float = 0.1

    def __str__(self) -> str:
        return f"scale to {self.scale:.2g}, axes to {self.angle_deg:g} deg, offsets to {self.offset:.2g} of the field"

    def std(self, sensors: int) -> Array:
        """(12 S,) of the parameters."""
        one = np.full((3, 4), np.radians(self.angle_deg))
        one[:, :3][np.diag_indices(3)] = self.scale
        one[:, 3] = self.offset
        return np.tile(one.ravel(), sensors)


def fit_nominal(
    raw: Array,
    total_field: Array,
    nominal: Nominal,
    *,
    noise: Array | None = None,
    reference_noise: float = 0.0,
    worst_error: float = WORST_ERROR,
    keep: Mask | None = None,
    complete: bool = True,
    quiet_field: Array | None = None,
    start: JointFit | None = None,
    known: Coverage | None = None,
) -> JointFit:
    """Fit C and o of all sensors to their outputs and the total field, beside what is known of them beforehand.

    Parameters
    ----------
    raw: (N, S, 3) nT, finite; total_field: (N,) nT, positive. A total field that is a mere constant will do: what it
        errs by is a scale that all sensors share, within the prior.
    nominal: the prior.
    noise, reference_noise, worst_error, keep, complete, known: as in `joint.fit_recording`. A complete model is also
        held against the prior.
    quiet_field: (N,) nT, the total field without the reference's own noise; the total field itself when None.
    start: a fit of nearly the same outputs, to begin with; sensors at nominal when None, and where it leads nowhere.

    Raises
    ------
    NotEnoughData: fewer than `LEAST_SAMPLES`, or more than half of the samples disagree with any calibration.
    DataError: the sensors do not see one field, or a parameter lies beyond the prior.
    """
    sensors = raw.shape[1]
    for s in range(sensors):
        checked_samples(raw[:, s], total_field)
    believed = np.ones(len(raw), dtype=bool) if keep is None else np.array(keep, dtype=bool)
    if believed.sum() < LEAST_SAMPLES:
        raise NotEnoughData(
            f"{int(believed.sum())} samples are too few to tell noise from an effect",
            hint=f"{LEAST_SAMPLES} are the least",
        )
    if np.median(np.abs(raw)) > LARGEST * np.mean(total_field):
        raise DataError("the outputs are no field near the total field", hint="look for wrong units")
    unit = float(np.mean(total_field[believed]))
    asked = _Asked(raw, total_field, unit, nominal.std(sensors), noise, reference_noise, keep)
    rows = np.tile(np.eye(3, 4), (sensors, 1))
    ways: list[tuple[Array, Array | None, Callable[..., tuple[Here, Array, float]]]]
    ways = [(rows, noise, settled), (rows, noise, settled_slowly)]
    if start is not None:
        near = np.column_stack([start.forward.reshape(-1, 3), start.offset.ravel() / unit])
        ways.insert(0, (near, start.plane.noise, settled))
    found, refusal = None, NotEnoughData(DIVERGES, hint=HINT)
    for begin, own, steps in ways:
        try:
            found = _fitted(asked, begin, own, steps, believed)
        except NotEnoughData as error:
            refusal = error
        if found is not None:
            break
    if found is None:
        raise refusal
    data, here, covariance, believed = found
    y = here.plane.coordinates(raw)
    seen = along(here.matrix, here.offset, y.T, total_field if quiet_field is None else quiet_field, 0.0)
    # the foot point in the metric of the noise: what is left of the noise in it has nothing in common with |b| - F
    beyond = seen.residual * np.sqrt(seen.own)
    field = (seen.unit * seen.length - seen.turned * (beyond / seen.own)).T
    still = np.linalg.eigvalsh(np.cov(field.T))[0] < (QUIETEST * unit) ** 2
    if still:  # to the last digit: what the quietest sensor would add keeps it apart from a constant
        field = field + QUIETEST * unit * np.random.default_rng(0).standard_normal(field.shape)
    return _found(data, here, covariance, nominal, believed, field, worst_error, complete, known)


@dataclass(frozen=True)
class _Asked:
    """What `fit_nominal` is asked for, the prior's standard deviations std (12 S,) with it."""

    raw: Array
    total_field: Array
    unit: float
    std: Array
    noise: Array | None
    reference_noise: float
    keep: Mask | None


def _fitted(
    asked: _Asked, rows: Array, own: Array | None, steps: Callable[..., tuple[Here, Array, float]], believed: Mask
) -> tuple[NominalData, Here, Array, Mask] | None:
    """Parameters, noise and believed samples in turn until they rest, from given parameters rows (3 S, 4) and, unless
    None, noise own (3 S,); None where that goes astray: steps that do not end, or noise beyond what the outputs can
    hold.

    Raises
    ------
    NotEnoughData: as in `fit_nominal`.
    """
    raw, total_field, unit = asked.raw, asked.total_field, asked.unit
    flat = raw.reshape(len(raw), -1)
    loudest = LOUDEST * _rms(np.maximum(second_difference_std(flat[believed]), QUIETEST * unit))
    own = _noise(rows, flat, total_field, unit, believed) if own is None else np.asarray(own).ravel()
    weights = (0.0, 0.0)
    for round_ in range(_ROUNDS):
        data = NominalData(flat[believed], total_field[believed], unit, own, asked.reference_noise)
        before = weights
        weights = weights_of(data, data.at(rows))
        here, covariance, step = steps(data, rows, weights, asked.std)
        rows = here.rows
        rests = round_ > 0 and all(abs(np.log(a / b)) < 0.05 for a, b in zip(weights, before, strict=True))
        if asked.keep is None:
            again = _believed(data, here, raw, total_field, asked.reference_noise, believed)
            rests = rests and np.array_equal(again, believed)
            believed = again
        if asked.noise is None:
            now = _noise(rows, flat, total_field, unit, believed)
            if not _rms(now) <= loudest:  # nor where it is no number
                return None
            rests = rests and bool(np.max(np.abs(np.log(now / own))) < 0.02)
            own = own if rests else now
        if rests:
            break
    return (data, here, covariance, believed) if step <= ASTRAY else None


def _noise(rows: Array, flat: Array, total_field: Array, unit: float, believed: Mask) -> Array:
    """(3 S,) nT white noise of the outputs, from second differences of the calibrated fields."""
    b = _fields(rows, flat[believed], unit)
    found = noise_std(b, total_field[believed]) ** 2
    forward = rows[:, :3].reshape(-1, 3, 3)
    own = np.sqrt(np.einsum("sij,sj->si", forward**2, found)).ravel()
    return np.maximum(own, QUIETEST * unit)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _fields(rows: Array, flat: Array, unit: float) -> Array:
    """(N, S, 3) nT of each sensor alone."""
    sensors = len(rows) // 3
    forward, offset = rows[:, :3].reshape(sensors, 3, 3), rows[:, 3].reshape(sensors, 3) * unit
    out: Array = by_sensor(np.linalg.inv(forward), flat.reshape(len(flat), sensors, 3) - offset)
    return out


def _believed(
    data: NominalData, here: Here, raw: Array, total_field: Array, reference_noise: float, before: Mask
) -> Mask:
    """(N,) samples that noise explains, as in the joint fit without a prior."""
    scalar = ScalarFit(here.matrix, here.offset, float("nan"), NOTHING)
    everything = Together(raw, total_field, np.zeros(len(raw), dtype=np.int_))
    limits = limits_of(Found(here.plane, scalar, before), everything, reference_noise, len(raw))
    seen = along(here.matrix, here.offset, here.plane.coordinates(raw).T, total_field, reference_noise)
    good = seen.residual**2 <= limits.along
    if raw.shape[1] > 1:
        good &= np.sum(here.plane.residual(raw) ** 2, axis=1) <= limits.across
    if good.sum() < 0.5 * len(raw):
        raise NotEnoughData(
            "more than half of the samples disagree with any one calibration",
            hint="look for a moving magnetic object, a dead axis or wrong units",
        )
    return np.asarray(good)


def _found(
    data: NominalData,
    here: Here,
    covariance: Array,
    nominal: Nominal,
    believed: Mask,
    field: Array,
    worst_error: float,
    complete: bool,
    known: Coverage | None,
) -> JointFit:
    sensors = len(here.rows) // 3
    forward, offset = here.rows[:, :3].reshape(sensors, 3, 3), here.rows[:, 3].reshape(sensors, 3) * data.unit
    chi2 = float(np.sum(here.across**2)) / (len(data.x) * max(len(here.rows) - 3, 1))
    plane = CommonField(data.noise, here.plane.basis, here.plane.mean, len(data.x), chi2)
    scalar = ScalarFit(here.matrix, here.offset, float(np.mean(here.along**2)), NOTHING)
    q = nearest_frame(forward)
    seen = known or coverage(
        scalar.field(plane.coordinates(data.x)) @ q, data.total_field, matrix=np.eye(3), offset=np.zeros(3),
        worst_error=worst_error, noise=None if complete else float(np.sqrt(np.mean(data.noise**2))),
    )  # fmt: skip
    std = nominal.std(sensors)
    if complete:
        _require_nominal(here.rows, std, nominal)
        some = slice(None, None, max(1, len(data.x) // 20_000))
        require_agreement(_fields(here.rows, data.x[some], data.unit), data.total_field[some])
    to_frame = frame_projection(forward @ q) @ _ordered(sensors, q, data.unit)
    covariance = to_frame @ covariance @ to_frame.T
    prior = to_frame @ np.diag(std**2) @ to_frame.T
    return JointFit(forward, offset, plane, scalar, believed, seen, posterior=Posterior(covariance, prior, field))


def _ordered(sensors: int, q: Array, unit: float) -> Array:
    """(12 S, 12 S): from the parameters to C Q, row by row, and o in nT, sensor after sensor."""
    one = np.zeros((12, 12))
    for i in range(3):
        one[3 * i : 3 * i + 3, 4 * i : 4 * i + 3] = q.T
        one[9 + i, 4 * i + 3] = unit
    return np.asarray(np.kron(np.eye(sensors), one), dtype=np.float64)


def _require_nominal(rows: Array, std: Array, nominal: Nominal) -> None:
    """Refuse parameters that the prior does not know.

    Raises
    ------
    DataError: a parameter farther from nominal than `FARTHEST` standard deviations.
    """
    away = (rows - np.tile(np.eye(3, 4), (len(rows) // 3, 1))).ravel() / std
    worst = int(np.argmax(np.abs(away)))
    if abs(away[worst]) <= FARTHEST:
        return
    sensor, output, column = worst // 12 + 1, "xyz"[worst % 12 // 4], worst % 4
    what = "offset" if column == 3 else "scale factor" if "xyz"[column] == output else f"part along {'xyz'[column]}"
    raise DataError(
        f"the attitudes do not determine a calibration, and sensor {sensor} is not near nominal: the {what} of its "
        f"{output} output would lie {abs(away[worst]):.3g} standard deviations from what is assumed",
        hint=f"assumed are {nominal.scale:.0%} of scale, {nominal.angle_deg:g} deg and an offset of "
        f"{nominal.offset:.0%} of the field: turn the platform about more than one axis, widen what is assumed, or "
        "look for wrong units or axes",
    )
