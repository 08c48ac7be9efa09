"""The colour of the noise: white plus a sum of slow processes, and the filter that makes it white.

Fluxgates have 1/f noise. Whatever treats it as white sees drifts, temperature effects and steps where there are
none (METHODS A2 step 1). The spectrum of the residual is fitted by a white level and relaxation processes of
decade time constants with non-negative weights; the filter divides by its square root in the cosine transform,
which keeps trends from leaking round the ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.mixture import likeliest_mixture
from magtensor.calibration.types import Array

_COLUMNS = 16  # filtered at a time
_SHORT = np.array([1.0, 3.0, 10.0])  # time constants in samples
_LEAST = 64  # samples, of fewer the noise is taken for white
_LEAST_OF_SHORT = 100  # of them in a survey, or it is not short
_LEAST_LEFT = 1e-3  # frequencies' worth of noise, where a series was taken off them
_SETTLING = 3  # rounds in which a colour and what goes with the field settle


@dataclass(frozen=True)
class Colour:
    """A power spectrum over the N cosine frequencies, relative to its white level.

    Attributes:
        power: (N,), at least 1; None for white noise.
        white: the white level, in the units of the squared residual.
    """

    power: Array | None
    white: float

    @property
    def lowest(self) -> float:
        """Power at the lowest frequency over the white level."""
        return 1.0 if self.power is None else float(self.power[0])

    def among(self, samples: int) -> Colour:
        """The same for a series with more or fewer samples."""
        if self.power is None or len(self.power) == samples:
            return self
        own = np.arange(len(self.power)) / len(self.power)
        return replace(self, power=np.interp(np.arange(samples) / samples, own, self.power))

    def louder(self, times: float) -> Colour:
        """The same of noise with so many times the power."""
        return self if times == 1.0 else replace(self, white=self.white * times)

    def log_volume(self, count: int) -> float:
        """The sum of the logarithms of the spectrum, for a series of so many samples."""
        spread = 0.0 if self.power is None else float(np.sum(np.log(self.power)))
        return count * float(np.log(self.white)) + spread

    def whiten(self, series: Array, *, back: bool = True) -> Array:
        """Filter (N,) or (N, K) so that noise of this colour becomes white with unit variance.

        Without `back` it stays in the cosine transform, where sums of products over all samples are the same.
        """
        scale = 1.0 / np.sqrt(self.white)
        if self.power is None:
            return series * scale
        from scipy.fft import dct, idct

        # column by column in memory, where a transform is twice as fast
        spectrum = dct(np.array(series.reshape(len(series), -1).T, order="C"), axis=1, norm="ortho", overwrite_x=True)
        spectrum *= scale / np.sqrt(self.power)
        if back:
            spectrum = idct(spectrum, axis=1, norm="ortho", overwrite_x=True)
        return np.asarray(spectrum.T).reshape(series.shape)


def colour_of(
    series: Array, freedom: float | None = None, *, stiff: bool = False, above: int = 1, left: Array | None = None
) -> Colour:
    """Fit white noise plus slow processes to the mean spectrum of the columns of (N, K).

    Parameters
    ----------
    series: residuals.
    freedom: how many independent values a row holds; K if None.
    stiff: white, 1/f, 1/f^2 and processes of a few samples only, so that the lowest frequencies follow from the
        middle ones. What a regressor took away there, having followed the noise, is then not missed.
    above: number of the lowest cosine frequency that counts, where many regressors left nothing below; from what is
        left white noise and 1/f are known, and no steeper law.
    left: (N,) part of the noise at each cosine frequency that the series hold, where something was taken off; all where
        not given.
    """
    columns = series.reshape(len(series), -1)
    n, k = columns.shape
    share = (freedom or k) / k
    if n < _LEAST:
        return _white(columns, share)
    power = mean_power(columns, share)
    frequency = np.arange(1, n) / (2.0 * n)  # cycles per sample
    edges = np.unique(np.round(np.geomspace(1, n, min(60, n // 4))).astype(int))
    edges = edges[edges >= min(above, n // 2)]
    held = np.diff(edges) * 1.0 if left is None else np.maximum(np.add.reduceat(left[1:], edges[:-1] - 1), _LEAST_LEFT)
    level = np.add.reduceat(power, edges[:-1] - 1) / held
    centre = (edges[:-1] + edges[1:] - 1) / (4.0 * n)
    count = held * k * share
    shapes_of = (_laws if above == 1 else _flicker) if stiff else _relaxations
    shapes = shapes_of(centre, n)
    found, best = likeliest_mixture(level, count, shapes)
    white = found[0]
    if white <= 0:
        white = float(np.min(best))
    every = np.concatenate([[frequency[0] / 2], frequency])
    total = white + shapes_of(every, n, found[1:] > 0)[:, 1:] @ found[1:][found[1:] > 0]
    relative = np.maximum(total / white, 1.0)
    if relative[1] < 1.05:
        return Colour(None, white)
    return Colour(relative, white)


def _white(columns: Array, share: float) -> Colour:
    return Colour(None, max(float(np.mean(columns**2)) / share, 1e-300))


def mean_power(columns: Array, share: float = 1.0) -> Array:
    """(N - 1,) mean power of the columns of (N, K) at the cosine frequencies above zero."""
    from scipy.fft import dct

    n, k = columns.shape
    power = np.zeros(n)
    for start in range(0, k, _COLUMNS):
        part = np.array(columns[:, start : start + _COLUMNS].T, order="C")
        power += np.sum(dct(part, axis=1, norm="ortho", overwrite_x=True) ** 2, axis=0)
    return power[1:] / (k * share)


def beside_the_field(series: Array, affine: Array) -> tuple[Array, Colour]:
    """(N,) or (N, K) without what of it goes with the field, told apart by colour, and the colour of what is left.

    The fit holds its noise for white. Of slow noise, each output's own, its C and o take a part that turns with the
    field, and so put one waveform into all of them.
    """
    left = series
    for _ in range(_SETTLING):
        colour = colour_of(left.reshape(len(left), -1))
        taken = np.linalg.lstsq(colour.whiten(affine), colour.whiten(series), rcond=1e-12)[0]
        left = series - affine @ taken
    return left, colour


def _relaxations(frequency: Array, n: int, chosen: NDArray[np.bool_] | None = None) -> Array:
    """White noise and first-order processes of time constants from two samples to ten surveys, (M, 1 + Q), or of these
    processes the chosen ones (Q,)."""
    taus = np.geomspace(2.0, 10.0 * n, 3 * max(2, int(np.log10(n))))
    return _beside_white(frequency, [partial(_relaxation, tau=t) for t in taus], chosen)


def _laws(frequency: Array, n: int, chosen: NDArray[np.bool_] | None = None) -> Array:
    """White noise, 1/f and 1/f^2, each 1 at the survey's own frequency, and short first-order processes, (M, 1 + Q), or
    of all but the white noise the chosen ones (Q,).

    A base station that is read more seldom than the sensors leaves noise with a plateau, which the laws alone would
    take for the beginning of a steep rise.
    """
    short = _SHORT[n > _LEAST_OF_SHORT * _SHORT]
    laws = [partial(_power_law, n=n, exponent=1), partial(_power_law, n=n, exponent=2)]
    return _beside_white(frequency, [*laws, *(partial(_relaxation, tau=t) for t in short)], chosen)


def _flicker(frequency: Array, n: int, chosen: NDArray[np.bool_] | None = None) -> Array:
    """White noise and 1/f alone, (M, 2), or where it is not chosen the former, (M, 1)."""
    return _beside_white(frequency, [partial(_power_law, n=n, exponent=1)], chosen)


def _beside_white(
    frequency: Array, shapes: Sequence[Callable[[Array], Array]], chosen: NDArray[np.bool_] | None
) -> Array:
    wanted = shapes if chosen is None else [shape for shape, yes in zip(shapes, chosen, strict=True) if yes]
    return np.column_stack([np.ones_like(frequency), *(shape(frequency) for shape in wanted)])


def _power_law(frequency: Array, n: int, exponent: int) -> Array:
    """Power of 1 / frequency, 1 at the survey's own frequency."""
    out: Array = (1.0 / (2.0 * n * frequency)) ** exponent
    return out


def _relaxation(frequency: Array, tau: float) -> Array:
    """Spectrum of a first-order process of time constant tau (in samples), 1 at zero frequency."""
    decay = np.exp(-1.0 / tau)
    out: Array = (1 - decay) ** 2 / (1 - 2 * decay * np.cos(2 * np.pi * frequency) + decay**2)
    return out
