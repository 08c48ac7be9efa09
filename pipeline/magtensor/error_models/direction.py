"""What could follow the attitude, whatever the law: monomials of the field's direction and of logged vectors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magtensor.attitude import into_platform
from magtensor.calibration.types import Array
from magtensor.error_models.excitation import VECTORS, Excitation

LINE = 20.0  # power over the median of what is beside it: one in ten thousand by chance, in the largest of a hundred
KNOTS = 17  # of a curve: an eighth of the field apart, which offsets of an array's sensors do not blur
OF_A_TONE = 3.0  # times what a tone of the outputs makes of a line itself, that the platform's turning makes more
DEGREE = 3  # of the field's direction, the largest
WIDTH = 4  # frequencies, a survey's length apart, beyond which the window shows nothing of a line
CELLS = (
    4096  # that a series is summed in, turned by the line's own frequency: those beside turn by 0.02 rad in half one
)
CELLS_AT_ONCE = 128
BESIDE = np.array([s * k for k in range(WIDTH, 31, 3) for s in (-1, 1)])  # such frequencies, the nearest first


def direction_series(x: Excitation) -> Array:
    """(N, K): second and third degree of the field's direction, and its rate of change.

    The first degree is the fit's own: it belongs to C.
    """
    u = _unit(x.field[:, 0])
    rate = x.derivative(u)
    spread = rate.std()
    columns = [u[:, i] * u[:, j] for i in range(3) for j in range(i, 3) if (i, j) != (2, 2)]
    thirds = [(i, j, k) for i in range(3) for j in range(i, 3) for k in range(j, 3) if (i, j, k) != (2, 2, 2)]
    columns += [u[:, i] * u[:, j] * u[:, k] for i, j, k in thirds]
    if spread > 0:
        columns += [rate[:, i] / spread for i in range(3)]
    return np.column_stack(columns)


def turning_series(x: Excitation) -> Array:
    """(N, 3): the way in which the field's direction turns, of length 1 however fast: what has a memory of where it was
    lies behind by an amount that does not grow with the rate."""
    rate = x.derivative(_unit(x.field[:, 0]))
    size = np.linalg.norm(rate, axis=1, keepdims=True)
    return np.divide(rate, size, out=np.zeros_like(rate), where=size > 0)


def attitude_series(x: Excitation) -> Array:
    """(N, K): `direction_series`, and every logged attitude, acceleration and rate, alone and times the direction."""
    u = _unit(x.field[:, 0])
    columns = [direction_series(x)]
    vectors = [x.logged[name] / max(x.logged[name].std(), 1e-300) for name in VECTORS if name in x.logged]
    if x.attitude is not None:
        vectors += [into_platform(x.attitude, axis) for axis in np.eye(3)[[0, 2]]]
    for v in vectors:
        columns += [v, np.einsum("ni,nj->nij", u, v).reshape(len(v), -1)]
    return np.column_stack(columns)


def curve_series(x: Excitation) -> Array:
    """(N, K): any curve of each component of the field's direction, straight between knots: what kinks or has steps is
    no polynomial of low degree."""
    u = _unit(x.field[:, 0])
    at = (u + 1.0) * (KNOTS - 1) / 2.0
    return np.concatenate([np.maximum(1.0 - np.abs(at - knot), 0.0) for knot in range(KNOTS)], axis=1)


def turning_Hz(x: Excitation) -> float:
    """How often the platform turns in a second, rms; without attitude only the turning of the field tells."""
    axes = [_unit(x.field[:, 0])]
    if x.attitude is not None:
        axes = [into_platform(x.attitude, axis) for axis in np.eye(3)]
    squares = sum(np.mean(np.sum(x.derivative(axis) ** 2, axis=1)) for axis in axes)
    return float(np.sqrt(squares / (2.0 if len(axes) == 3 else 1.0)) / (2.0 * np.pi))  # three axes show a turn twice


def turning_lines(x: Excitation, frequencies_Hz: Sequence[float], tones_nT: Sequence[float]) -> Array:
    """(F,) the largest amplitude with which the attitude, in units of its own series, has a line at each frequency; 0
    where none of them has. Any law of the attitude has one there, with a memory or without.

    Parameters
    ----------
    tones_nT: (F,) amplitudes of the outputs' own lines, which the direction that is made of the outputs has too, and
        its rate of change far more.
    """
    if not len(frequencies_Hz):
        return np.zeros(0)
    series = attitude_series(x)
    total = float(np.median(np.linalg.norm(x.field[:, 0], axis=1)))
    rate = x.derivative(_unit(x.field[:, 0])).std()
    shown = np.full((len(frequencies_Hz), series.shape[1]), float(DEGREE))  # of a change of the direction by one
    if rate > 0:  # the last of the series that are made of the direction alone
        last = direction_series(x).shape[1]
        shown[:, last - 3 : last] = 2.0 * np.pi * np.asarray(frequencies_Hz)[:, None] / rate
    return largest_lines(series, x, frequencies_Hz, OF_A_TONE * shown * np.asarray(tones_nT)[:, None] / total)


def largest_lines(series: Array, x: Excitation, frequencies_Hz: Sequence[float], least: Array | None = None) -> Array:
    """(F,) the largest amplitude with which one of several series (N, K) has a line at each frequency; 0 where none of
    them has, or none of more than (F, K) `least`."""
    window = np.blackman(len(series) + 2)[1:-1]
    window /= window.sum()
    mean = window @ series
    since = x.time - x.time[0]
    step = 1.0 / max(x.duration, 1e-300)
    starts = np.flatnonzero(np.diff(np.floor(since * step * CELLS), prepend=-1.0))  # of stretches of equal length
    within = np.add.reduceat(since, starts) / np.diff(starts, append=len(since))
    sums = np.zeros((len(frequencies_Hz), len(starts), series.shape[1]), dtype=complex)
    for first in range(0, len(starts), CELLS_AT_ONCE):
        cells = starts[first : first + CELLS_AT_ONCE]
        rest = starts[first + CELLS_AT_ONCE : first + CELLS_AT_ONCE + 1]
        piece = slice(cells[0], rest[0] if len(rest) else len(since))
        weighed = (series[piece] - mean) * window[piece, None]
        for sum_, frequency in zip(sums, frequencies_Hz, strict=True):
            turned = np.exp(-2j * np.pi * frequency * since[piece])[:, None]
            sum_[first : first + len(cells)] = np.add.reduceat(weighed * turned, cells - cells[0])
    asked = np.exp(-2j * np.pi * step * np.outer(np.concatenate([[0.0], BESIDE]), within))
    out = np.zeros(len(frequencies_Hz))
    for i, sum_ in enumerate(sums):
        here, *beside = 2.0 * np.abs(asked @ sum_)
        next_to_it = np.max(beside[:2], axis=0)  # larger on the skirts of another line
        line = (here**2 > LINE * np.median(beside, axis=0) ** 2) & (here > next_to_it)
        if least is not None:
            line &= here > least[i]
        out[i] = np.max(here, initial=0.0, where=line)
    return out


def _unit(vectors: Array) -> Array:
    out: Array = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return out
