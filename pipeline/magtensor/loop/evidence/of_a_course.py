"""How unlikely a course is in |b| - F, whose noise may be slow, smooth and strong: what a base station does not see.

A cosine transform goes on beyond the ends as in a mirror. What is smooth has two kinks there, of which all its high
frequencies are made: values of two that are independent, the same for all that is smooth. A fit that holds its noise
for white makes more of the kind: it puts some of what is strong into what turns with the field.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.estimate import IDENTIFIABLE
from magtensor.loop.evidence.one_series import in_octaves
from magtensor.loop.evidence.sensor_noise import over_frequency, smoothed_spectrum

PREDICTED_BY = 24  # values, where a series is smooth
SMOOTH = 30.0  # its largest power over the smallest, of their roots
_SETTLING = 3  # rounds in which a spectrum and what goes with the field settle
_INNER_RANK = 1e-6  # of the largest singular value


def of_a_course(columns: Array, units: Array | None, even: Callable[[Array], Array], resolved: int) -> float:
    """P value of a course, octave by octave.

    Where what is left is smooth it is asked beside a straight line and a parabola, which have kinks of the same kind,
    and of what is new in each sample (prewhitening, Blackman and Tukey 1958); the larger p value is taken.

    Parameters
    ----------
    columns: (N, 2 + Q) the residual along the field, the course as it shows in that, and what is free beside it.
    units: (N,) 1/nT, in which they are: of the sensors' noise, which turns with the field; None where they are in one
        only.
    even: brings series to an even rate; resolved: how many of the lowest frequencies count.
    """
    spectra = over_frequency(even(columns))
    root, _ = _settled(spectra[:, 0], spectra[:, 2:])
    if units is None or root.max() <= SMOOTH * root.min():
        return _in_these(spectra, resolved)
    series = even(columns / units[:, None])  # in units that turn, what is slow and strong turns too
    spectra = over_frequency(series)
    root, taken = _settled(spectra[:, 0], spectra[:, 2:])
    noise = spectra[:, 0] - root * (taken @ (taken.T @ (spectra[:, 0] / root)))
    time = np.linspace(-1.0, 1.0, len(series))
    ends = over_frequency(np.column_stack([time, time**2]))
    new = over_frequency(_unpredicted(series, noise))
    return max(_in_these(np.column_stack([spectra, ends]), resolved), _in_these(new, resolved))


def _in_these(spectra: Array, resolved: int) -> float:
    """The same over frequency."""
    fitted, whole = spectra[:, 0], spectra[:, 1]
    root, taken = _settled(fitted, spectra[:, 2:])
    column, values = (each / root - taken @ (taken.T @ (each / root)) for each in (whole, fitted))
    if np.sum(column**2) <= IDENTIFIABLE * np.sum((whole / root) ** 2):
        return 1.0
    counts = slice(resolved)
    return in_octaves(column[counts], values[counts, None], taken[counts])


def _settled(values: Array, free: Array) -> tuple[Array, Array]:
    """The root (N,) of the power of values (N,) over frequency that are left when columns (N, Q) have explained their
    part in noise of that power, and (N, R) orthonormal what these can explain, whitened."""
    left = values
    for _ in range(_SETTLING):
        root = np.sqrt(smoothed_spectrum(left**2))
        basis, size, _ = np.linalg.svd(free / root[:, None], full_matrices=False)
        taken = basis[:, size > _INNER_RANK * size.max(initial=0.0)]
        left = values - root * (taken @ (taken.T @ (values / root)))
    return root, taken


def _unpredicted(series: Array, spectrum: Array) -> Array:
    """(N - P, K) what is new in each value of series (N, K) to one that knows how a noise goes on, by its cosine
    spectrum (N,)."""
    from scipy.fft import idct

    noise = idct(spectrum, norm="ortho")
    before = np.lib.stride_tricks.sliding_window_view(noise[:-1], PREDICTED_BY)[:, ::-1]
    parts = np.linalg.lstsq(before, noise[PREDICTED_BY:], rcond=None)[0]
    count = len(series)
    out: Array = series[PREDICTED_BY:] - sum(
        part * series[PREDICTED_BY - i : count - i] for i, part in enumerate(parts, start=1)
    )
    return out
