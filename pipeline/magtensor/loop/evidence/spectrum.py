"""Lines in the spectrum of a residual.

Sought at the frequencies of whole periods in the survey and halfway between them: of each set noise is independent, and
a line that lies between two frequencies of one set, where it loses up to six tenths of its power, is near one of the
other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.loop.evidence.colour import Colour, beside_the_field, colour_of
from magtensor.loop.evidence.residual import Residual

MOST_MISSING = 0.25  # of the samples of an even grid
_ON_THE_GRID = 0.1  # of a step, that an interval may be off it
_SPREAD = 10  # places of the fine grid to either side that a sample is spread over: to 1e-9
_OF_A_MEDIAN = 2.0 / np.pi  # of what a mean of as many values tells
_LEAST_SAMPLES = 256
_LEAST_PERIODS = 10  # in a survey, of a slow line: one in each held-out fold
_BESIDE = 3.0  # frequencies, a survey's length apart, that are one line
_LEAST_TURNED = 1e-2  # of the largest mean square of the direction's components, from which on one is known
_LEAST_VARIANCE = 1e-6  # of the largest, of the noise of a coordinate


@dataclass(frozen=True)
class _Grid:
    """When the samples were taken.

    Attributes:
        places: (N,) steps since the first; step: s; n: places of the grid; even: whether the samples lie on it.
    """

    places: Array
    step: float
    n: int
    even: bool

    @classmethod
    def of(cls, time: Array) -> _Grid:
        """Of times (N,) in s."""
        step = float(np.median(np.diff(time)))
        steps = np.rint(np.diff(time) / step)
        off = np.abs(np.diff(time) - steps * step).max()
        even = bool(steps.min() >= 1.0 and off <= _ON_THE_GRID * step)
        places = np.concatenate([[0.0], np.cumsum(steps)]) if even else (time - time[0]) / step
        return cls(places, step, int(np.rint(places[-1])) + 1, even)

    def spectra(self, coordinates: Array) -> Iterator[tuple[Array, NDArray[np.complex128]]]:
        """Frequencies (M,) in Hz and the spectrum (M, K) of coordinates (N, K) at them: at whole periods in the survey,
        above none and below the highest of an even number of samples, which has one phase and not two; and halfway."""
        places, n = self.places, self.n
        found = (
            _of_a_grid(coordinates, places, n)
            if self.even
            else transform(coordinates, places, 2 * n) * (n / len(places))
        )
        for half in (0, 1):
            m = np.arange(2 - half, n, 2)
            yield m / (2 * n * self.step), found[m]

    def left_by(self, colour: Colour, frequency_Hz: Array) -> Array:
        """(M,) of an amplitude, what a filter that makes noise of a colour as white as its white part leaves."""
        power = colour.power
        if power is None:
            return np.ones(len(frequency_Hz))
        own = np.arange(len(power)) / (2.0 * len(power))
        return np.asarray(1.0 / np.sqrt(np.interp(frequency_Hz * self.step, own, power)))


@dataclass(frozen=True)
class _Line:
    frequency_Hz: float
    rms_nT: float
    p: float  # not cut off at one, for the order


def spectral_lines(residual: Residual, time: Array, most: int = 5) -> list[tuple[float, float, float]]:
    """(frequency Hz, rms nT, p) of the strongest peaks over the smooth spectrum of what differs between the sensors,
    and of what is left of |b| - F as a field fixed to the platform makes it.

    p is that of the largest of all peaks under noise without lines. The lowest frequencies, where no smooth spectrum
    can be told from a line, are left out: of what differs between the sensors those of less than ten periods. So are
    surveys that lack more than a quarter of their samples. Those that are missing from an even grid are interpolated;
    where the times lie on none, each sample counts at its own.
    """
    if len(time) < _LEAST_SAMPLES:
        return []
    grid = _Grid.of(time)
    if len(time) < (1.0 - MOST_MISSING) * grid.n:
        return []
    lines: list[_Line] = []
    for line in sorted([*_between(residual, grid, most), *_on_the_platform(residual, grid, most)], key=lambda o: o.p):
        if all(abs(line.frequency_Hz - other.frequency_Hz) >= _BESIDE / (grid.n * grid.step) for other in lines):
            lines.append(line)
    return [(line.frequency_Hz, line.rms_nT, min(1.0, line.p)) for line in lines[:most]]


def line_of_the_station(residual: Residual, time: Array) -> tuple[float, float, float] | None:
    """(frequency Hz, rms nT, p) of the strongest peak of |b| - F itself, as an error of the base station makes it; None
    where too many samples are missing, or there is no |b| - F."""
    grid = _Grid.of(time) if len(time) >= _LEAST_SAMPLES else None
    if grid is None or residual.along is None or len(time) < (1.0 - MOST_MISSING) * grid.n:
        return None
    left = (residual.along / residual.reference_gain)[:, None]
    found: list[_Line] = []
    for frequency, spectrum in grid.spectra(left):
        rms = np.sqrt(2.0) * np.abs(spectrum[:, 0]) / grid.n
        found += _largest(spectrum, left, rms, frequency, grid, 1, slow=True)
    line = min(found, key=lambda o: o.p, default=None)
    return (line.frequency_Hz, line.rms_nT, min(1.0, line.p)) if line else None


def _between(residual: Residual, grid: _Grid, most: int) -> list[_Line]:
    """Of what differs between the sensors. What C took of slow noise turns with the platform, at a rate that would seem
    a line, and is put back (`colour.beside_the_field`)."""
    if residual.across is None:
        return []
    values, vectors = np.linalg.eigh(residual.projector)
    coordinates, colour = beside_the_field(residual.across @ vectors[:, values > 0.5], residual.affine)
    if not grid.even:  # what is slow would show at all frequencies, as the times scatter, in all coordinates alike
        coordinates = colour.whiten(coordinates) * np.sqrt(colour.white)
    lines = []
    for frequency, spectrum in grid.spectra(coordinates):
        square = 2.0 * np.sum(np.abs(spectrum) ** 2, axis=1) / coordinates.shape[1]
        rms = np.sqrt(square) / grid.n * residual.scale / (1.0 if grid.even else grid.left_by(colour, frequency))
        lines += _largest(spectrum, coordinates, rms, frequency, grid, most, slow=True)
    return lines


def _on_the_platform(residual: Residual, grid: _Grid, most: int) -> list[_Line]:
    """Of a vector on the platform, alike at all sensors: |b| - F holds its part along the field, whose direction turns.
    The rms is that of |b| - F."""
    if residual.along is None:
        return []
    field = residual.affine[:, :3]
    direction = field / np.linalg.norm(field, axis=1, keepdims=True)
    colour = colour_of(residual.along)
    # what is slow, a drift of the base station, would turn with the direction
    left = colour.whiten(residual.along) * np.sqrt(colour.white) / residual.reference_gain
    shown = np.linalg.pinv(direction.T @ direction / len(direction), rcond=_LEAST_TURNED, hermitian=True)
    lines = []
    for frequency, spectrum in grid.spectra(left[:, None] * direction):
        square = 2.0 * np.einsum("mi,ij,mj->m", spectrum.conj(), shown, spectrum).real
        rms = np.sqrt(np.maximum(square, 0.0)) / grid.n / grid.left_by(colour, frequency)
        lines += _largest(spectrum, left[:, None] * direction, rms, frequency, grid, most)
    return lines


def _largest(
    spectrum: NDArray[np.complex128],
    coordinates: Array,
    rms_nT: Array,
    frequency_Hz: Array,
    grid: _Grid,
    most: int,
    *,
    slow: bool = False,
) -> list[_Line]:
    """The strongest peaks of a spectrum (M, K) of coordinates (N, K) over its running median; among them, if asked for,
    slow ones, judged by as few frequencies beside them as there are, and as if the coordinates shared one series: what
    is slow may be one effect."""
    from scipy.special import chdtri, fdtrc

    alike = _alike(coordinates)
    k = alike.shape[1]
    power = np.sum(np.abs(spectrum @ alike) ** 2, axis=1) / grid.n
    width = max(len(power) // 100, 15)
    smooth, lowest = _running_median(power, width), min(2 * width, len(power))
    ratio = power / np.maximum(smooth, 1e-300) * chdtri(2 * k, 0.5) / 2.0  # to the scale of k exponentials' sum
    p = fdtrc(2 * k, 2 * k * _OF_A_MEDIAN * (2 * width + 1), ratio / k)
    first = min(_LEAST_PERIODS, lowest) if slow else lowest
    p[:first] = 1.0
    for i in range(first, lowest):
        beside = i // 2
        over = power[i] / max(float(np.median(power[i - beside : i + beside + 1])), 1e-300) * np.log(2.0)
        p[i] = fdtrc(2, 2 * _OF_A_MEDIAN * (2 * beside + 1), over)
    lines: list[_Line] = []
    for i in np.lexsort((-ratio, p)):
        if len(lines) == most:
            break
        if any(abs(frequency_Hz[i] - other.frequency_Hz) < _BESIDE / (grid.n * grid.step) for other in lines):
            continue
        lines.append(_Line(float(frequency_Hz[i]), float(rms_nT[i]), float(p[i]) * 2 * len(power)))
    return lines


def _of_a_grid(coordinates: Array, places: Array, n: int) -> NDArray[np.complex128]:
    """(n + 1, K) Fourier transform of coordinates (N, K) at places of a grid, between which they are straight, at every
    half period in it."""
    from scipy.fft import rfft

    if n > len(places):
        coordinates = np.column_stack([np.interp(np.arange(float(n)), places, column) for column in coordinates.T])
    return np.asarray(rfft(coordinates, n=2 * n, axis=0))


def transform(coordinates: Array, places: Array, n: int) -> NDArray[np.complex128]:
    """(n // 2 + 1, K) sums of coordinates (N, K) times exp(-2 pi i m place / n).

    Spread over a grid twice as fine with a Gaussian (Greengard and Lee, SIAM Review 46, 443, 2004), to 1e-9.

    Parameters
    ----------
    places: (N,) times in steps since the first, ascending, in [0, n).
    """
    from scipy.fft import rfft

    fine = 2 * n
    width = np.sqrt(2.0) * _SPREAD / np.pi  # of exp(-d^2 / width): what is cut off and what aliases are as small
    nearest = np.rint(2.0 * places).astype(int)
    spread = np.zeros((fine, coordinates.shape[1]))
    for beside in range(-_SPREAD, _SPREAD + 1):
        part = np.exp(-((nearest + beside - 2.0 * places) ** 2) / width)
        for column, out in zip(coordinates.T, spread.T, strict=True):
            out += np.bincount((nearest + beside) % fine, weights=part * column, minlength=fine)
    m = np.arange(n // 2 + 1)
    undone = np.exp(width * (np.pi * m / fine) ** 2) / np.sqrt(np.pi * width)
    return np.asarray(rfft(spread, axis=0))[: len(m)] * undone[:, None]


def _alike(coordinates: Array) -> Array:
    """(K, k) what makes the fast noise of coordinates (N, K) independent and alike, its mean variance kept: the largest
    of sums of K squares is no line where one axis, louder than all others, makes nearly all of each sum. Axes without
    any are left out, as all but one are of a direction that does not turn."""
    fast = np.diff(coordinates, n=2, axis=0)
    variance, axes = np.linalg.eigh(fast.T @ fast / len(fast))
    seen = variance > _LEAST_VARIANCE * variance[-1]
    if not seen.any():
        seen[-1] = True
    least = np.maximum(variance[seen], 1e-300)
    out: Array = axes[:, seen] / np.sqrt(least) * np.sqrt(variance.mean())
    return out


def _running_median(values: Array, width: int) -> Array:
    from scipy.ndimage import median_filter

    out: Array = median_filter(values, size=2 * width + 1, mode="reflect")
    return out
