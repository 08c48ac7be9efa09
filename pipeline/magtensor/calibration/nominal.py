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

from dataclasses import dataclass

import numpy as np

from magtensor.errors import DataError, NotEnoughData

from .agreement import require_agreement
from .by_sensor import by_sensor
from .common_field import CommonField
from .coverage import WORST_ERROR, coverage
from .joint import JointFit, Posterior, nearest_frame
from .joint_covariance import frame_projection
from .joint_together import Found, Together, limits_of
from .maximum_likelihood import NOTHING, ScalarFit, along
from .noise import noise_std, second_difference_std
from .scalar import checked_samples
from .types import Array, Mask

LEAST_SAMPLES = 50
QUIETEST = 1e-7  # of F: no sensor is believed to be better
FARTHEST = 5.0  # standard deviations of the prior
BLOCKS = (120, 30, 12)
ELSEWHERE = 0.1  # of the field's variance: samples whose neighbours differ by more do not follow each other
ROUNDING = 1e-13
CLOSE = 0.01  # standard deviations of what is fitted: of the last step
ASTRAY = 10.0  # the same: no step leads to a fit, as of outputs that an effect which ran away has been taken off
LARGEST = 100.0  # of F: of outputs that an effect which ran away has been taken off
LOUDEST = 3.0  # times what outputs differ by from sample to sample: more noise they hold in no calibration
DIVERGES, HINT = "the fit near nominal does not converge", "look for disturbed samples"
_ROUNDS = 8
_STEPS = 20
_FARTHEST_STEP = 1.0  # standard deviations of the prior


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


@dataclass(frozen=True)
class _Here:
    """Where the fit stands, at parameters rows (3 S, 4).

    Attributes:
        plane, matrix, offset: of these parameters, as in `CommonField` and `ScalarFit`.
        field: (N, 3) nT; direction: (N, 3).
        across: (N, 3 S) and along: (N,), whitened residuals; inverse_std: (N,) 1/nT, of |b| - F.
    """

    rows: Array
    plane: CommonField
    matrix: Array
    offset: Array
    field: Array
    direction: Array
    across: Array
    along: Array
    inverse_std: Array

    def inner(self, direction: Array, z: Array) -> Array:
        """(N, 12) change of the residual along with each coordinate of the plane times z (N, 4)."""
        gain = self.inverse_std[:, None] * (direction @ self.matrix)
        return np.asarray((gain[:, :, None] * z[:, None]).reshape(len(z), 12))


@dataclass(frozen=True)
class _Data:
    """Samples that are believed: x (N, 3 S) nT, total field (N,) nT with its mean unit, noise (3 S,) nT."""

    x: Array
    total_field: Array
    unit: float
    noise: Array
    reference_noise: float

    def at(self, rows: Array) -> _Here:
        """Field and residuals at given parameters."""
        scaled = rows * (self.unit / self.noise)[:, None]
        basis, triangle = np.linalg.qr(scaled[:, :3] / self.unit)
        plane = CommonField(self.noise, basis, scaled[:, 3], len(self.x), float("nan"))
        matrix, offset = np.asarray(np.linalg.inv(triangle), dtype=np.float64), basis.T @ scaled[:, 3]
        y = plane.coordinates(self.x)
        seen = along(matrix, offset, y.T, self.total_field, self.reference_noise)
        field = (seen.unit * seen.length).T
        across = plane.residual(self.x)
        return _Here(rows, plane, matrix, offset, field, seen.unit.T, across, seen.residual, seen.inverse_std)

    def basis(self, here: _Here) -> Array:
        """(4, 4) T: the parameters of an output times T belong to series that have nothing in common.

        A field that hardly turns is nearly a constant, and of products of the two rounding leaves little.
        """
        return np.asarray(np.linalg.qr(self._seen(here), mode="r") / np.sqrt(len(here.field)))

    def _seen(self, here: _Here) -> Array:
        """(N, 4): the field, and what an offset is multiplied by."""
        return np.column_stack([here.field / self.unit, np.ones(len(here.field))])

    def equations(self, here: _Here, weights: tuple[float, float], basis: Array) -> tuple[Array, Array, Array]:
        """Scores (12 S,), their change with the parameters in a basis (12 S, 12 S), and their covariance.

        A residual times what the field of the neighbouring samples would make it: their noise is not in the residual.
        """
        across, inside = weights
        apart = np.linalg.inv(basis)
        z = self._seen(here) @ apart
        towards = _neighbours(here.field)
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        other = np.column_stack([towards * (self.total_field / self.unit)[:, None], np.ones(len(z))]) @ apart
        scale = self.unit / self.noise
        off = (np.eye(len(scale)) - here.plane.basis @ here.plane.basis.T) * np.outer(scale, scale)
        score = across * ((here.across * scale).T @ other).ravel()
        change = across * np.kron(off, other.T @ z)
        covariance = across * np.kron(off, other.T @ other)
        own, theirs = here.inner(here.direction, z), here.inner(towards, other)
        into = np.kron(here.plane.basis.T * scale, np.eye(4))
        score = score + inside * into.T @ (theirs.T @ here.along)
        change = change + inside * into.T @ (theirs.T @ own) @ into
        covariance = covariance + inside * into.T @ (theirs.T @ theirs) @ into
        return np.asarray(score), np.asarray(change), np.asarray(covariance)

    def misfit(self, here: _Here) -> tuple[Array | None, Array]:
        """Residual across (N, 3 S), None for one sensor, and along (N, 1), less what C and o could still explain."""
        z = np.column_stack([here.direction * (self.total_field / self.unit)[:, None], np.ones(len(here.field))])
        inside = least(here.along[:, None], here.inner(here.direction, z))
        return (least(here.across, z) if len(self.noise) > 3 else None), inside


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
) -> JointFit:
    """Fit C and o of all sensors to their outputs and the total field, beside what is known of them beforehand.

    Parameters
    ----------
    raw: (N, S, 3) nT, finite; total_field: (N,) nT, positive. A total field that is a mere constant will do: what it
        errs by is a scale that all sensors share, within the prior.
    nominal: the prior.
    noise, reference_noise, worst_error, keep, complete: as in `joint.fit_recording`. A complete model is also held
        against the prior.
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
    flat = raw.reshape(len(raw), -1)
    unit = float(np.mean(total_field[believed]))
    std = nominal.std(sensors)
    rows = np.tile(np.eye(3, 4), (sensors, 1))
    if start is not None:
        rows = np.column_stack([start.forward.reshape(-1, 3), start.offset.ravel() / unit])
    loudest = LOUDEST * _rms(np.maximum(second_difference_std(flat[believed]), QUIETEST * unit))
    own = _noise(rows, flat, total_field, unit, believed) if noise is None else np.asarray(noise).ravel()
    here, covariance, weights, step = None, np.zeros(0), (0.0, 0.0), 0.0
    for round_ in range(_ROUNDS):
        data = _Data(flat[believed], total_field[believed], unit, own, reference_noise)
        before = weights
        weights = _weights(data, data.at(rows))
        here, covariance, step = _settled(data, rows, weights, std)
        rows = here.rows
        settled = round_ > 0 and all(abs(np.log(a / b)) < 0.05 for a, b in zip(weights, before, strict=True))
        if keep is None:
            again = _believed(data, here, raw, total_field, reference_noise, believed)
            settled = settled and np.array_equal(again, believed)
            believed = again
        if noise is None:
            now = _noise(rows, flat, total_field, unit, believed)
            settled = settled and bool(np.max(np.abs(np.log(now / own))) < 0.02)
            own = own if settled else now
        if settled or (noise is None and not _rms(own) <= loudest):
            break
    assert here is not None
    astray = not step <= ASTRAY or (noise is None and not _rms(own) <= loudest)  # nor where it is no number
    if astray and start is not None:
        return fit_nominal(
            raw, total_field, nominal, noise=noise, reference_noise=reference_noise, worst_error=worst_error, keep=keep,
            complete=complete, quiet_field=quiet_field,
        )  # fmt: skip
    if astray:
        raise NotEnoughData(DIVERGES, hint=HINT)
    y = here.plane.coordinates(raw)
    seen = along(here.matrix, here.offset, y.T, total_field if quiet_field is None else quiet_field, 0.0)
    # the foot point in the metric of the noise: what is left of the noise in it has nothing in common with |b| - F
    beyond = seen.residual * np.sqrt(seen.own)
    field = (seen.unit * seen.length - seen.turned * (beyond / seen.own)).T
    still = np.linalg.eigvalsh(np.cov(field.T))[0] < (QUIETEST * unit) ** 2
    if still:  # to the last digit: what the quietest sensor would add keeps it apart from a constant
        field = field + QUIETEST * unit * np.random.default_rng(0).standard_normal(field.shape)
    return _found(data, here, covariance, nominal, believed, field, worst_error, complete)


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


def least(values: Array, columns: Array) -> Array:
    """Values (N, K) less what columns (N, M), of any rank, explain of them."""
    out: Array = values - columns @ np.linalg.lstsq(columns, values, rcond=1e-9)[0]
    return out


def _neighbours(field: Array) -> Array:
    """(N, 3) the mean of the samples before and after; the field (N, 3) itself where these lie elsewhere (postures)."""
    padded = np.concatenate([field[1:2], field, field[-2:-1]])
    out: Array = (padded[:-2] + padded[2:]) / 2.0
    far = np.mean((out - field) ** 2) > ELSEWHERE * np.mean((field - field.mean(axis=0)) ** 2)
    return field.copy() if far else out


def _weights(data: _Data, here: _Here) -> tuple[float, float]:
    """How far samples are believed, across and along: one over what the misfit is beyond white noise."""
    across, inside = data.misfit(here)
    return 1.0 / _long_run(across) if across is not None else 1.0, 1.0 / _long_run(inside)


def _long_run(series: Array) -> float:
    """The largest variance that means over blocks have, times the length of the block: 1 for white noise, whatever
    correlation in time does to a mean for other series (N, K)."""
    n, k = series.shape
    worst = 1.0
    for blocks in (n, *BLOCKS):
        if blocks > n:
            continue
        edges = np.linspace(0, n, blocks, endpoint=False).round().astype(int)
        lengths = np.diff([*edges, n])
        sums = np.add.reduceat(series, edges, axis=0) / np.sqrt(lengths)[:, None]
        top = float(np.linalg.eigvalsh(sums.T @ sums / blocks)[-1])
        chance = (1.0 + np.sqrt(k / blocks)) ** 2  # edge of the spectrum of white noise (Marchenko and Pastur 1967)
        worst = max(worst, top / chance)
    return worst


def _settled(data: _Data, rows: Array, weights: tuple[float, float], std: Array) -> tuple[_Here, Array, float]:
    """The parameters most probable for given weights, their covariance (12 S, 12 S), and the last step in its standard
    deviations.

    The scores are a linear function of the parameters with noise of known covariance: beside the prior the best linear
    estimate, and again from there.
    """
    nominal = np.tile(np.eye(3, 4), (len(rows) // 3, 1))
    here, size = data.at(rows), np.inf
    for _ in range(_STEPS):
        basis = data.basis(here)
        into = np.kron(np.eye(len(rows)), basis) * std
        score, change, covariance = data.equations(here, weights, basis)
        away = (here.rows - nominal).ravel() / std
        root = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        values, vectors = np.linalg.eigh(covariance / np.outer(root, root))
        real = values > ROUNDING * values[-1]
        whiten = vectors.T[real] / np.sqrt(values[real])[:, None] / root
        # no products of these: what the samples know beside the prior differs by fourteen orders of magnitude
        shown = np.vstack([whiten @ change @ into, np.eye(len(root))])
        said = np.concatenate([whiten @ score, -away])
        if not (np.isfinite(shown).all() and np.isfinite(said).all()):
            raise NotEnoughData(DIVERGES, hint=HINT)
        left, known, right = np.linalg.svd(shown, full_matrices=False)
        moved = left.T @ said / known
        moved /= max(1.0, float(np.max(np.abs(right.T @ moved))) / _FARTHEST_STEP)
        here = data.at(nominal + ((away + right.T @ moved) * std).reshape(rows.shape))
        size = float(np.linalg.norm(known * moved))
        if size < CLOSE:
            break
    root_covariance = std[:, None] * right.T / known
    return here, np.asarray(root_covariance @ root_covariance.T), size


def _believed(data: _Data, here: _Here, raw: Array, total_field: Array, reference_noise: float, before: Mask) -> Mask:
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
    data: _Data,
    here: _Here,
    covariance: Array,
    nominal: Nominal,
    believed: Mask,
    field: Array,
    worst_error: float,
    complete: bool,
) -> JointFit:
    sensors = len(here.rows) // 3
    forward, offset = here.rows[:, :3].reshape(sensors, 3, 3), here.rows[:, 3].reshape(sensors, 3) * data.unit
    chi2 = float(np.sum(here.across**2)) / (len(data.x) * max(len(here.rows) - 3, 1))
    plane = CommonField(data.noise, here.plane.basis, here.plane.mean, len(data.x), chi2)
    scalar = ScalarFit(here.matrix, here.offset, float(np.mean(here.along**2)), NOTHING)
    q = nearest_frame(forward)
    seen = coverage(
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
