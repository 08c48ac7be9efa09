"""Lines in the spectrum of what is left, and which of them may be the platform's turning.

Where a platform turns steadily any law of the attitude has lines, and one with a memory (a part that swings, a filter)
has them in other phases than the monomials of the attitude. So a line at a frequency at which the attitude has one too
is no evidence of a tone, unless it is larger than any such law would make it.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.direction import largest_lines, turning_lines
from magtensor.error_models.excitation import Excitation
from magtensor.loop.evidence.spectrum import spectral_lines
from magtensor.loop.fitting.model import State

MOST = 5  # lines that are looked for tones at
CHANCE = 0.005  # probability that the strongest line of noise is taken for one
HARMONICS = 5  # powers of a channel, whose lines its own law may have: a saturation has odd ones
LARGEST_LAW = 0.01  # of the field, that a law of the attitude makes of an attitude's line


def tones(state: State, time: Array) -> tuple[float, ...]:
    """Hz of the strongest lines that noise does not make and that are no more than likely the turning's, or of the law
    of an adopted model that follows a channel with such a line, `time` being that of all samples. No test of a tone by
    itself would know that it was taken from a thousand frequencies."""
    x = state.excitation
    lines = spectral_lines(state.residual, time[state.residual.samples], most=2 * MOST)
    lines = [line for line in lines if line[2] < CHANCE]
    theirs = of_the_turning(x, [f for f, _, _ in lines], [rms for _, rms, _ in lines])
    followed = {name for model in state.adopted for name in model.channels(x)}
    left = (f for (f, _, _), its in zip(lines, theirs, strict=True) if not its)
    return tuple(itertools.islice((f for f in left if not channels_of_the_line(x, f, followed)), MOST))


def of_the_turning(x: Excitation, frequencies_Hz: Sequence[float], rms_nT: Sequence[float]) -> list[bool]:
    """Whether a law of the attitude may make lines of that rms."""
    total = float(np.median(np.linalg.norm(x.field[:, 0], axis=1)))
    amplitudes = [float(np.sqrt(2.0) * rms) for rms in rms_nT]
    most = LARGEST_LAW * total * turning_lines(x, frequencies_Hz, amplitudes)
    return [own < largest for own, largest in zip(amplitudes, most.tolist(), strict=True)]


def channels_of_the_line(x: Excitation, frequency_Hz: float, among: Collection[str] | None = None) -> tuple[str, ...]:
    """Logged channels, all or some, with a line at a frequency, or with a power that has one, or a law with a corner or
    a step: what follows such a channel, late or by a law of its own, is not told from a tone."""
    found = []
    for name, values in sorted(x.logged.items()):
        if among is not None and name not in among:
            continue
        course = (values - values.mean(axis=0)) / np.maximum(values.std(axis=0), 1e-300)
        each = course.reshape(len(course), -1)
        size = np.linalg.norm(values.reshape(len(course), -1), axis=1)
        laws = [*(each**k for k in range(1, HARMONICS + 1)), np.abs(each), np.sign(each), size]
        if largest_lines(np.column_stack(laws), x, [frequency_Hz])[0] > 0:
            found.append(name)
    return tuple(found)
