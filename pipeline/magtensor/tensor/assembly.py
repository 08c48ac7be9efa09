"""From the calibrated fields of several sensors to one tensor: every assembly is a linear map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import DataError, NotEnoughData
from magtensor.tensor.elements import AXES, FIVE_OF_NINE, NINE_OF_FIVE
from magtensor.tensor.geometry import (
    RANK_TOLERANCE,
    Determination,
    Order,
    array_centre,
    array_design,
    array_radius,
    checked_positions,
    determination,
    harmonic_design,
)

Array = NDArray[np.float64]

_HIGHEST_DEGREE_EXAMINED = 8


@dataclass(frozen=True)
class Assembly:
    """A linear map from the fields of S sensors to the tensor and to the field at the array's centre.

    Attributes:
        name: of the method that made it.
        gain: (3, 3, S, 3) 1/m; tensor[i, j] = sum_sk gain[i, j, s, k] b[s, k]. NaN in elements not measured.
        field_gain: (3, S, 3); the field at the centre.
        centre: (3,) m in the platform frame, the point that tensor and field refer to.
        determined: the elements this map measures, "Gxx", ...
        truncation_order: n where the relative error of the tensor of a source at distance r falls as
            (size of the array / r)^n.
        notes: what a user of this tensor has to know.
    """

    name: str
    gain: Array
    field_gain: Array
    centre: Array
    determined: tuple[str, ...]
    truncation_order: int
    notes: tuple[str, ...] = ()

    def apply(self, b: Array) -> Array:
        """Tensor (..., 3, 3) nT/m from calibrated fields b (..., S, 3) nT in one common frame."""
        return _linear(self.gain, self.checked_fields(b))

    def field(self, b: Array) -> Array:
        """Field at the centre (..., 3) nT from calibrated fields b (..., S, 3) nT."""
        return _linear(self.field_gain, self.checked_fields(b))

    @property
    def symmetric(self) -> bool:
        """Whether every tensor it gives is symmetric and traceless."""
        rounding = 1e-9 * float(np.nanmax(np.abs(self.gain)))
        return bool(np.allclose(_projected(self.gain), self.gain, rtol=0, atol=rounding))

    def symmetrised(self) -> Assembly:
        """The same with Bxy and its mirror averaged, and a third of the trace taken off the diagonal."""
        notes = tuple(n for n in self.notes if n != NOT_SYMMETRISED)
        return replace(self, gain=_projected(self.gain), notes=notes)

    def checked_fields(self, b: Array) -> Array:
        """`b` as float64 (..., S, 3); DataError when it is not of this array's shape."""
        values = np.asarray(b, dtype=float)
        if values.shape[-2:] != self.field_gain.shape[1:]:
            raise DataError(
                f"the field has shape {values.shape}, the array has {self.field_gain.shape[1]} sensors",
                where="b",
                hint="(time, sensor, 3) with the sensors of `position` is right",
            )
        return values


NOT_SYMMETRISED = "not symmetrised: Bxy and Byx are measured by different sensors and kept apart"


def _linear(gain: Array, b: Array) -> Array:
    rows = gain.reshape(-1, gain.shape[-2] * gain.shape[-1])
    out: Array = (b.reshape(*b.shape[:-2], -1) @ rows.T).reshape(*b.shape[:-2], *gain.shape[:-2])
    return out


def _projected(gain: Array) -> Array:
    """The gain (3, 3, S, 3) of the symmetric traceless part."""
    out: Array = (NINE_OF_FIVE @ FIVE_OF_NINE @ gain.reshape(9, -1)).reshape(gain.shape)
    return out


def assembly_from_gain(
    name: str, gain: Array, field_gain: Array, position: Array, notes: tuple[str, ...] = ()
) -> Assembly:
    """An `Assembly`; its centre, determined elements and truncation order follow from gain and positions.

    Parameters
    ----------
    gain : (3, 3, S, 3) 1/m; field_gain : (3, S, 3); position : (S, 3) m.
    """
    measured = np.isfinite(gain).all(axis=(2, 3))
    determined = tuple(f"G{AXES[i]}{AXES[j]}" for i, j in np.argwhere(measured))
    return Assembly(
        name,
        gain,
        field_gain,
        array_centre(position),
        determined,
        _truncation_order(gain[measured].reshape(-1, 3 * len(position)), position),
        notes + _duplicates(position),
    )


def _truncation_order(rows: Array, position: Array) -> int:
    """Two less than the lowest degree above 2 whose harmonics leak into the tensor."""
    radius = array_radius(position)
    displacement = (position - array_centre(position)) / radius
    for degree in range(3, _HIGHEST_DEGREE_EXAMINED):
        leak = rows @ harmonic_design(displacement, degree) * radius
        if np.abs(leak).max() > RANK_TOLERANCE:
            return degree - 2
    return _HIGHEST_DEGREE_EXAMINED - 2


def _duplicates(position: Array) -> tuple[str, ...]:
    distance = np.linalg.norm(position[:, None] - position[None], axis=-1)
    pairs = np.argwhere(np.triu(distance <= RANK_TOLERANCE * array_radius(position), 1))
    return tuple(f"sensors {i + 1} and {j + 1} share one position" for i, j in pairs)


def least_squares_assembly(
    position: Array, noise_covariance: Array | None = None, highest_order: Order = "gradient"
) -> Assembly:
    """Weighted least squares for the field and the tensor at the centre, from any geometry.

    Parameters
    ----------
    position : (S, 3) m.
    noise_covariance : (3 S, 3 S) nT^2 of the calibrated fields, sensor after sensor; None weighs all alike.
    highest_order : the highest gradient that is fitted along with the tensor. "second" and "third" remove the
        finite-baseline error of that order where the geometry allows it, and cost noise.

    Raises
    ------
    NotEnoughData : the geometry cannot determine all five components; the message names those it cannot.
    DataError : positions or covariance of a wrong shape, or a covariance that is not positive definite.
    """
    r = checked_positions(position)
    found = determination(r, highest_order)
    if found.undetermined:
        raise _cannot_determine(r, found, highest_order)
    whitening = _whitening(noise_covariance, 3 * len(r))
    radius = array_radius(r)
    solve = _solver(array_design(r, highest_order), whitening)
    field = solve[:3]
    notes: tuple[str, ...] = ()
    if not found.field:
        field = _solver(array_design(r, "gradient"), whitening)[:3]
        notes = ("the field at the centre is that of a linear field: this geometry lacks its curvature",)
    gain = (NINE_OF_FIVE @ solve[3:8] / radius).reshape(3, 3, -1, 3)
    return assembly_from_gain("least_squares", gain, field.reshape(3, -1, 3), r, notes)


def unconstrained_assembly(position: Array, noise_covariance: Array | None = None) -> Assembly:
    """All nine derivatives on their own, div B = curl B = 0 not imposed; NaN where the geometry lacks them.

    For quality control: what `closure` makes of its tensors must be noise. A planar array has no derivative
    along its normal, an array in a plane that is oblique to the axes none along any axis.
    """
    r = checked_positions(position)
    displacement = (r - array_centre(r)) / (array_radius(r) or 1.0)
    line = np.hstack([np.ones((len(r), 1)), displacement])
    _, s, vt = np.linalg.svd(line, full_matrices=True)
    null = vt[int(np.sum(s > RANK_TOLERANCE * s[0])) :, 1:]
    unmeasured = np.flatnonzero(np.linalg.norm(null, axis=0) > RANK_TOLERANCE)
    if len(unmeasured) == 3:
        raise NotEnoughData("these sensor positions give no derivative along x, y or z", where="position")
    design = np.einsum("sa,ij->siaj", line, np.eye(3)).reshape(3 * len(r), -1)
    solve = _solver(design, _whitening(noise_covariance, 3 * len(r)))
    gain = solve[3:].reshape(3, 3, -1, 3).swapaxes(0, 1) / array_radius(r)
    gain[:, unmeasured] = np.nan
    return assembly_from_gain("unconstrained", gain, solve[:3].reshape(3, -1, 3), r, (NOT_SYMMETRISED,))


def _cannot_determine(position: Array, found: Determination, highest_order: Order) -> NotEnoughData:
    rest = f"; only {', '.join(found.combinations)} can be" if found.combinations else ""
    beside, hint = "", "three sensors that do not lie on one line are the least"
    if not determination(position).undetermined:
        beside = f" beside the terms up to the {highest_order} gradient"
        hint = "choose a lower highest_order, or add sensors at other distances from the centre"
    what = f"{', '.join(found.undetermined)} cannot be determined{beside}: {found.reason}{rest}"
    return NotEnoughData(what, where="position", hint=hint)


def _whitening(noise_covariance: Array | None, size: int) -> Array:
    """(size, size) W with W' W proportional to the inverse covariance."""
    if noise_covariance is None:
        return np.eye(size)
    covariance = checked_noise_covariance(noise_covariance, size // 3)
    try:
        lower = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise DataError(
            "the noise covariance of the sensors is not positive definite, so it cannot weigh them",
            where="noise_covariance",
            hint="every axis needs a noise above zero and every correlation must be below one",
        ) from None
    return np.linalg.inv(lower)


def checked_noise_covariance(noise_covariance: Array, sensors: int) -> Array:
    """(3 S, 3 S) nT^2 from that or from one (3, 3) per sensor, (S, 3, 3).

    Raises
    ------
    DataError : another shape, values that are not finite, or not symmetric.
    """
    c = np.asarray(noise_covariance, dtype=float)
    if c.shape == (sensors, 3, 3):
        c = np.einsum("sij,st->sitj", c, np.eye(sensors)).reshape(3 * sensors, 3 * sensors)
    if c.shape != (3 * sensors, 3 * sensors):
        raise DataError(
            f"the noise covariance has shape {c.shape}",
            where="noise_covariance",
            hint=f"({3 * sensors}, {3 * sensors}) or ({sensors}, 3, 3) in nT^2 is right",
        )
    if not np.isfinite(c).all() or not np.allclose(c, c.T, rtol=1e-9, atol=0):
        raise DataError("the noise covariance is not a finite symmetric matrix", where="noise_covariance")
    return c


def _solver(design: Array, whitening: Array) -> Array:
    """(n, 3 S): the (minimum-norm) weighted least-squares solution as a matrix on the data."""
    out: Array = np.linalg.pinv(whitening @ design, rcond=RANK_TOLERANCE) @ whitening
    return out
