"""By how much as a whole what the sensors show is later than a logged channel, or earlier: to a sample.

Of a channel that goes fast a delay of half its period leaves nothing to be seen, so that no grid of lags finds its way
there. What the residual has in common with the channel at every delay is a cross-correlation, which costs a few
Fourier transforms. It proposes delays only: each is scored beside the other settings, as a test of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import AnyChannel, AsAWhole, profiled
from magtensor.loop.evidence.multiplicity import effective_tests
from magtensor.loop.evidence.residual import Residual

LONGEST = 0.05  # of the survey: of what a log is late by, its end tells nothing
MOST_GAPS = 4.0  # times as long as the samples themselves: what is mostly gaps is not correlated
_LEAST = 1e-6  # of the square of a course, which the fit's freedom leaves of it
_POWER = "power"  # the setting that is the power of a channel


@dataclass(frozen=True)
class Delays:
    """What a residual has in common with logged channels at delays of a whole number of samples.

    Attributes:
        residual: of the samples; x: what error models see of all.
    """

    residual: Residual
    x: Excitation

    @cached_property
    def step(self) -> float:
        """s."""
        return self.x.spacing

    @cached_property
    def count(self) -> int:
        """Points of an even grid over the survey; 0 where most of it would be gaps."""
        points = round(self.x.duration / self.step) + 1
        return points if points <= MOST_GAPS * len(self.x.time) else 0

    @cached_property
    def reach(self) -> int:
        """Samples, of the longest delay."""
        return int(LONGEST * self.count)

    @cached_property
    def _size(self) -> int:
        from scipy.fft import next_fast_len

        return int(next_fast_len(self.count + self.reach, real=True))

    @cached_property
    def _asked(self) -> list[tuple[Array, Array]]:
        """What follows a channel is asked of the residual in two ways, as offsets and as changes of the scale: for each
        the transforms (K, m, L) of the m columns that a course of ones makes, times the residual of each of the K
        outputs, and the transforms (A + m, m, L) by which the columns that a course makes are perpendicular to the A
        that the fit's own freedom makes, and what they have in common with each other."""
        r = self.residual
        if r.across is not None:
            return [self._of(r.across, x, r.free_across) for x in (r.affine[:, -1:], r.affine[:, :3])]
        assert r.along is not None
        ways = [r.slow_modes.response]
        if len(r.noise) == 3:
            ways.append(r.gain * (self.x.output[r.samples, 0] / r.unit))
        return [self._of(r.along[:, None], x, r.free_along[: len(x)]) for x in ways]

    def _of(self, left: Array, made: Array, freedom: Array) -> tuple[Array, Array]:
        both = left[:, :, None] * made[:, None]
        known = np.concatenate([freedom[:, :, None] * made[:, None], made[:, :, None] * made[:, None]], axis=1)
        return self._transformed(both), self._transformed(known)

    def _transformed(self, columns: Array) -> Array:
        """(K, m, size // 2 + 1) of columns (n, K, m) at the residual's samples, each put at the nearest point."""
        from scipy.fft import rfft

        time = self.x.time[self.residual.samples]
        place = np.rint((time - self.x.time[0]) / self.step).astype(int)
        flat = columns.reshape(len(columns), -1).T
        even = np.stack([np.bincount(place, column, self._size) for column in flat])
        return np.asarray(rfft(even, axis=1)).reshape(*columns.shape[1:], -1)

    def of(self, channel: str, power: int, alpha: float) -> tuple[list[float], float]:
        """The delays, s, at which a power of a channel explains most by offsets and by scale factors, none among them
        if that is best, and how many independent tests all delays amount to.

        Parameters
        ----------
        alpha: probability at which all tests together are to be judged.
        """
        if (channel, power) not in self._found:  # several models follow one channel
            self._found[channel, power] = self._best(channel, power)
        best, near = self._found[channel, power]
        return best, effective_tests([near] * (2 * self.reach), alpha)

    @cached_property
    def _found(self) -> dict[tuple[str, int], tuple[list[float], float]]:
        return {}

    def _best(self, channel: str, power: int) -> tuple[list[float], float]:
        """The delays as in `of`, and how alike the channel is from one sample to the next; alike altogether where there
        is no delay to be asked for."""
        logged = self.x.logged[channel]
        if self.reach < 1 or self.x.is_vector(channel):
            return [], 1.0
        even = self.x.time[0] + self.step * np.arange(self.count)
        columns = logged.reshape(len(logged), -1) ** power
        course = np.stack([np.interp(even, self.x.time, column) for column in (columns - columns.mean(axis=0)).T])
        size = np.sum(course**2, axis=1)
        if not (size > 0).all():
            return [], 1.0
        best = {int(np.argmax(one)) - self.reach for one in self.explained(course)} - {-self.reach, 0, self.reach}
        near = float(np.min(np.sum(course[:, 1:] * course[:, :-1], axis=1) / size))
        return [self.step * d for d in sorted(best)], near

    def explained(self, courses: Array) -> list[Array]:
        """(2 reach + 1,) of the residual's square, in white noise, in each way by courses (C, count), the same for all
        sensors or one for each, later by each delay, from the earliest on."""
        from scipy.fft import irfft, rfft

        delays = np.arange(-self.reach, self.reach + 1)
        found = []
        for left, known in self._asked:
            total = np.zeros(len(delays))
            for number, course in enumerate(courses):
                seen, squared = (np.conj(np.asarray(rfft(c, self._size))) for c in (course, course**2))
                own = left[3 * number : 3 * number + 3] if len(courses) > 1 and len(left) > 1 else left
                size = known.shape[1]
                common = np.moveaxis(irfft(own * seen, self._size)[..., delays], 2, 0)  # (D, K, m)
                free = np.moveaxis(irfft(known[:-size] * seen, self._size)[..., delays], 2, 0)
                gram = np.moveaxis(irfft(known[-size:] * squared, self._size)[..., delays], 2, 0)
                least = _LEAST * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(size)
                gram = gram - np.swapaxes(free, 1, 2) @ free + least
                total += np.einsum("dkm,dmk->d", common, np.linalg.solve(gram, np.swapaxes(common, 1, 2)))
            found.append(total)
        return found


def delayed(
    model: Component, grid: Sequence[Mapping[str, Any]], delays: Delays, alpha: float
) -> tuple[list[dict[str, Any]], float]:
    """The settings of a grid with the channel later as a whole by the delays that suit it best, none of models that
    know no such form; and how many independent tests all delays amount to."""
    marks = profiled(model)
    forms = [(name, mark.lag) for name, mark in marks.items() if isinstance(mark, AsAWhole) and mark.lag in marks]
    channels = [name for name, mark in marks.items() if isinstance(mark, AnyChannel)]
    found, tests = [], 0.0
    for form, lag in forms if len(channels) == 1 else []:
        longest = marks[lag].high
        for rest in (settings for settings in grid if settings[lag] == 0.0):
            best, tried = delays.of(rest[channels[0]], int(rest.get(_POWER, 1)), alpha)
            found += [{**rest, lag: delay, form: True} for delay in best if delay <= longest]
            tests += tried
    return found, max(tests, 1.0)


def as_a_whole(model: Component, settings: Mapping[str, Any]) -> str:
    """The setting that is the delay of a channel as a whole, to a sample or so; "" where there is none."""
    marks = profiled(model).items()
    return next((mark.lag for name, mark in marks if isinstance(mark, AsAWhole) and settings.get(name)), "")
