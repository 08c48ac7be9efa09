"""Carry sensor noise and the uncertainty of the calibration through an assembly to the tensor."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.by_sensor import by_sensor
from magtensor.calibration.types import PARAMETERS_PER_SENSOR, ArrayCalibration
from magtensor.errors import DataError
from magtensor.tensor.assembly import Assembly, checked_noise_covariance
from magtensor.tensor.elements import FIVE_OF_NINE

Array = NDArray[np.float64]

_UPPER = np.array([0, 1, 2, 4, 5, 8])  # of the nine elements row by row; the others mirror them
_UPPER_OF_NINE = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])
_CHUNK = 16384  # samples at a time: a few MB of scratch for any array


@dataclass(frozen=True)
class TakenOff:
    """Disturbances that were taken off the raw outputs, with coefficients of uncertain size.

    Attributes:
        series: (N, K) nT per unit of a coefficient.
        response: (K, 3 S, P), which series a coefficient adds to which output.
        covariance: (12 S + P,) squared, of the calibration's parameters and the coefficients together.
    """

    series: Array
    response: Array
    covariance: Array

    def at(self, part: slice) -> TakenOff:
        """At some of the samples."""
        return replace(self, series=self.series[part])


def noise_covariance_of_components(assembly: Assembly, noise_covariance: Array) -> Array:
    """Covariance (5, 5) in (nT/m)^2 of xx, xy, xz, yy, yz from sensor noise, the same at every sample.

    Parameters
    ----------
    noise_covariance : (3 S, 3 S) or (S, 3, 3) nT^2, of the calibrated fields.
    """
    rows = _five_rows(assembly)
    out: Array = rows @ checked_noise_covariance(noise_covariance, assembly.field_gain.shape[1]) @ rows.T
    return out


def noise_tensor_std(assembly: Assembly, noise_covariance: Array) -> Array:
    """Standard deviation (3, 3) in nT/m of each element from sensor noise; NaN where it is not measured."""
    return np.sqrt(_noise_variance(_nine_rows(assembly), assembly, noise_covariance)).reshape(3, 3)


def component_covariance(
    assembly: Assembly,
    b: Array,
    *,
    noise_covariance: Array | None = None,
    calibration: ArrayCalibration | None = None,
    taken_off: TakenOff | None = None,
) -> Array:
    """Covariance (N, 5, 5) in (nT/m)^2 of the five components at every sample, noise and calibration added.

    Takes 200 bytes per sample: give long records in pieces.

    Parameters
    ----------
    b : (N, S, 3) nT, the calibrated fields.
    noise_covariance : (3 S, 3 S) or (S, 3, 3) nT^2, of the calibrated fields.
    calibration : the correction that made `b`, with its covariance. NaN in it makes the result NaN.
    taken_off : effects that were corrected before, at the same samples; its covariance then takes the other's place.
    """
    fields = assembly.checked_fields(b)
    out = np.zeros((len(fields), 5, 5))
    if noise_covariance is not None:
        out += noise_covariance_of_components(assembly, noise_covariance)
    if calibration is not None:
        upper = np.triu_indices(5)
        for part, values in _calibration_terms(_five_rows(assembly), upper, fields, calibration, taken_off):
            out[part, upper[0], upper[1]] += values
            mirrored = upper[0] != upper[1]
            out[part, upper[1][mirrored], upper[0][mirrored]] += values[:, mirrored]
    return out


def tensor_std(
    assembly: Assembly,
    b: Array,
    *,
    noise_covariance: Array | None = None,
    calibration: ArrayCalibration | None = None,
    taken_off: TakenOff | None = None,
) -> Array:
    """Standard deviation (N, 3, 3) in nT/m of every element at every sample, noise and calibration added.

    Parameters as in `component_covariance`; works through any number of samples in pieces.
    """
    distinct = _UPPER if assembly.symmetric else np.arange(9)
    copies = _UPPER_OF_NINE if assembly.symmetric else np.arange(9)
    found = _std(_nine_rows(assembly)[distinct], assembly, b, noise_covariance, calibration, taken_off)
    return found[:, copies].reshape(-1, 3, 3)


def mean_field_std(
    assembly: Assembly,
    b: Array,
    *,
    noise_covariance: Array | None = None,
    calibration: ArrayCalibration | None = None,
    taken_off: TakenOff | None = None,
) -> Array:
    """Standard deviation (N, 3) in nT of the field at the array's centre, noise and calibration added.

    Parameters as in `component_covariance`. A rotation of the frame that the covariance does not hold is not in it.
    """
    return _std(assembly.field_gain.reshape(3, -1), assembly, b, noise_covariance, calibration, taken_off)


def _std(
    rows: Array,
    assembly: Assembly,
    b: Array,
    noise_covariance: Array | None,
    calibration: ArrayCalibration | None,
    taken_off: TakenOff | None,
) -> Array:
    """Standard deviations (N, K) of the combinations rows (K, 3 S) of the calibrated fields."""
    fields = assembly.checked_fields(b)
    variance = np.zeros((len(fields), len(rows)))
    if noise_covariance is not None:
        variance += _noise_variance(rows, assembly, noise_covariance)
    if calibration is not None:
        each = np.arange(len(rows))
        for part, values in _calibration_terms(rows, (each, each), fields, calibration, taken_off):
            variance[part] += np.maximum(values, 0)  # rounding can make a zero variance negative
    return np.sqrt(variance)


def _noise_variance(rows: Array, assembly: Assembly, noise_covariance: Array) -> Array:
    covariance = checked_noise_covariance(noise_covariance, assembly.field_gain.shape[1])
    out: Array = np.einsum("ap,pq,aq->a", rows, covariance, rows)
    return out


def _nine_rows(assembly: Assembly) -> Array:
    out: Array = assembly.gain.reshape(9, -1)
    return out


def _five_rows(assembly: Assembly) -> Array:
    out: Array = FIVE_OF_NINE @ _nine_rows(assembly)
    return out


def _calibration_terms(
    rows: Array,
    pairs: tuple[NDArray[np.int_], ...],
    fields: Array,
    calibration: ArrayCalibration,
    taken_off: TakenOff | None,
) -> Iterator[tuple[slice, Array]]:
    """Yield (slice of samples, (n, pairs) covariance of rows[p] b and rows[q] b that the calibration causes).

    With b = M (m - o), d(row b) is linear in z = (m - o, 1) and in the parameters: row' db = z' E dp. So the
    covariance of two rows is the quadratic form z' (E_p C E_q') z, of one small matrix for all samples. A disturbance
    taken off with a coefficient of its own lengthens z by its series and the parameters by the coefficient.
    """
    sensors = fields.shape[1]
    size = PARAMETERS_PER_SENSOR * sensors
    covariance = np.asarray(calibration.covariance, dtype=float)
    if covariance.shape != (size, size) or calibration.matrix.shape != (sensors, 3, 3):
        raise DataError(
            f"the calibration has {len(calibration.matrix)} sensors, its covariance shape {covariance.shape}",
            where="calibration",
            hint=f"{sensors} sensors and a covariance ({size}, {size}) are right for this array",
        )
    inverse = np.linalg.inv(calibration.matrix)
    influence = np.stack([_influence(row.reshape(sensors, 3), calibration.matrix) for row in rows])
    if taken_off is not None:
        covariance = taken_off.covariance
        turned = np.einsum("rsi,sij->rsj", rows.reshape(len(rows), sensors, 3), calibration.matrix)
        own = -np.einsum("ro,kop->rkp", turned.reshape(len(rows), -1), taken_off.response)
        influence = np.block([
            [influence, np.zeros((*influence.shape[:2], own.shape[2]))],
            [np.zeros((*own.shape[:2], influence.shape[2])), own],
        ])  # fmt: skip
    forms = np.stack([influence[p] @ covariance @ influence[q].T for p, q in zip(*pairs, strict=True)])
    for start in range(0, len(fields), _CHUNK):
        part = slice(start, start + _CHUNK)
        raw = by_sensor(inverse, fields[part])
        parts = [raw.reshape(len(raw), -1), np.ones((len(raw), 1))]
        z = np.concatenate(parts if taken_off is None else [*parts, taken_off.series[part]], axis=1)
        yield part, np.stack([np.einsum("np,np->n", z @ form, z) for form in forms], axis=1)


def _influence(row: Array, matrix: Array) -> Array:
    """E (3 S + 1, 12 S) for one row of gains (S, 3)."""
    sensors = len(row)
    out = np.zeros((3 * sensors + 1, PARAMETERS_PER_SENSOR * sensors))
    for s in range(sensors):
        first = PARAMETERS_PER_SENSOR * s
        for i in range(3):
            for j in range(3):
                out[3 * s + j, first + 3 * i + j] = row[s, i]
        out[-1, first + 9 : first + 12] = -row[s] @ matrix[s]
    return out
