"""How unlikely terms are in noise whose spectrum is each sensor's own, whatever its law.

The loop's working colours are one for all outputs, they are laws of frequency, and stationary in each of the residual's
two parts. None of that holds where one sensor is worse than the others, or a base station wanders beside the site. What
is asked here needs none of it: coefficients are linear in the noise of the outputs, so the power of each sensor's noise
at each frequency, as measured, gives their covariance, the working colours being no more than weights (the sandwich of
White 1980, over frequencies). Slow noise of a sensor shows across the plane and, turned with the platform, along the
field; what it does in both is added up before it is squared.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.error_models.terms import REFERENCE, Terms, joined
from magtensor.loop.evidence.columns import across_directions, along_the_field
from magtensor.loop.evidence.one_coefficient import one_coefficient_p
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.evidence.statistics import Own, identifiable

LEAST = 64  # samples, of fewer the noise is taken for white
OCTAVE = 4  # frequencies in the lowest one
BAND = 8  # frequencies in the lowest band in which sensors are compared
MOST_MISSING = 0.25  # of the samples: longer gaps are shortened to that
ALIKE = 4.0  # values that the axes of one sensor are taken to be alike by
_SMOOTHING = 8  # rounds in which a course between the middles of octaves gets their levels
_SCORING = 30  # rounds in which the levels of the sensors are found
_INNER_RANK = 1e-6  # of the largest singular value
_LEAST_REFERENCE = 0.1  # of the power along the field, which is not the sensors'


@dataclass(frozen=True)
class OwnNoise:
    """The noise of a residual, for tests of terms beside those that are in already.

    Attributes:
        residual: of N samples.
        given: terms that are in; None without any.
    """

    residual: Residual
    given: Terms | None

    def p_value(self, terms: Terms) -> float:
        """Probability that noise explains as much as terms, at the residual's samples, do beside the given ones.

        The levels of the noise are those of all that is left, what the terms explain included, and known from few
        frequencies where they are slow. In one band what is explained is then a share of as many values as the level is
        known from (Satterthwaite 1946): beta-distributed, like the squared multiple correlation. Where bands of
        few and of many values come together that share has no bound of one, and would be far too unlikely; chi-square,
        as if the levels were known, errs to the other side in one band. The larger of both is taken. Of one coefficient
        of the reference the exact law is known (`one_coefficient`).
        """
        from scipy.special import betaincc, chdtrc

        if terms.count == 1 and np.all(terms.part_output == REFERENCE) and self.residual.sighted is None:
            return self._of_one_in_the_reference(terms)
        every = terms if self.given is None else joined([self.given, terms])
        across, along = self._across_of(every), self._along_of(every)
        size = every.count if across is None else across.into.shape[1]
        score, normal, alone = np.zeros(size), np.zeros((size, size)), np.zeros(every.count)
        if across is not None:
            self._add_across(across, score, normal)
        if along is not None:
            score[: every.count] += along.rows.T @ self._values_along
            normal[: every.count, : every.count] += along.rows.T @ along.rows
            alone += along.alone
        alone += np.diagonal(normal)[: every.count]
        tested = np.arange(every.count - terms.count, every.count)
        others = np.setdiff1d(np.arange(size), tested)
        seen = np.zeros((len(tested), size))
        seen[:, tested] = np.eye(len(tested))
        seen[:, others] = -normal[np.ix_(tested, others)] @ _inverse(normal[np.ix_(others, others)])
        seen = identifiable(seen @ normal @ seen.T, Own(alone[tested], terms.noise_of_each)).T @ seen
        rank = len(seen)
        if not rank:
            return 1.0
        parts, counts = self._noise_of(across, along, seen, every.count)
        inverse = np.linalg.pinv(parts.sum(axis=0), hermitian=True)
        share = np.einsum("ij,bji->b", inverse, parts)
        freedom = rank**2 / float(np.sum(share**2 / counts))
        if freedom <= rank + 1.0:
            return 1.0
        found = seen @ score
        explained = float(found @ inverse @ found)
        share_of_all = min(explained / freedom, 1.0)
        return max(float(betaincc(rank / 2.0, (freedom - rank) / 2.0, share_of_all)), float(chdtrc(rank, explained)))

    def _of_one_in_the_reference(self, terms: Terms) -> float:
        """The same of a single coefficient that is seen in |b| - F alone, octave by octave."""
        if self.residual.along is None:
            return 1.0
        count = len(self._along)
        every = terms if self.given is None else joined([terms, self.given])
        series = _frequencies(self._even(along_the_field(self.residual, [every]).made)) / self._root_along[:, None]
        column, others = series[:, 0], series[:, 1:]
        free = self._free_along
        more, size, _ = np.linalg.svd(others - free @ (free.T @ others), full_matrices=False)
        taken = np.column_stack([free, more[:, size > _INNER_RANK * max(size.max(initial=0.0), 1.0)]])
        column, values = (each - taken @ (taken.T @ each) for each in (column, self._values_along))
        octaves = 1 + OCTAVE * 2 ** np.arange(max(int(np.log2(count)), 1))
        edges = np.concatenate([[1], octaves[octaves < count // 2], [count]])

        def sums(each: Array) -> Array:
            return np.add.reduceat(each, edges[:-1])

        left = np.diff(edges) - sums(np.sum(taken**2, axis=1))
        return one_coefficient_p(left, sums(column * values), sums(column**2), sums(values**2))

    def slow_std(self) -> Array:
        """(3 S,) nT, rms of the slow noise of each output beside its white noise; 0 of a single sensor."""
        if self.residual.across is None:
            return np.zeros(len(self.residual.noise))
        each = np.diff(self._edges)
        power = np.repeat(self._levels, each, axis=0) * self._root_across[:, None] ** 2
        out: Array = np.sqrt(np.maximum(np.mean(power - power[-1], axis=0), 0.0)) * self.residual.noise
        return out

    def slow_along(self) -> float:
        """nT rms of the total field that the slow noise of the sensors makes; 0 of a single sensor."""
        residual = self.residual
        seen = residual.gain * (self.slow_std() / residual.noise) / residual.reference_gain[:, None]
        return float(np.sqrt(np.mean(np.sum(seen**2, axis=1))))

    def _across_of(self, terms: Terms) -> _Across | None:
        """What terms do across, and what C and o can do."""
        residual = self.residual
        raw = terms.part_output != REFERENCE
        if residual.across is None or not raw.any():
            return None
        size, own, count = len(residual.noise), residual.affine.shape[1], terms.series.shape[1]
        outputs = terms.part_output[raw]
        weights = terms.part_weight[raw] / residual.noise[outputs]
        into = np.zeros((count + own, terms.count + own * size, size))
        np.add.at(into, (terms.part_series[raw], terms.part_term[raw], outputs), weights)
        for a in range(own):
            first = terms.count + a * size
            into[count + a, first : first + size] = np.eye(size)
        series = _frequencies(self._even(np.hstack([terms.series, residual.affine]))) / self._root_across[:, None]
        series[0] = 0.0
        return _Across(series, into)

    def _along_of(self, terms: Terms) -> _Along | None:
        """The columns of terms along the field, whitened, what C and o can do taken off."""
        residual, rows = self.residual, []
        if residual.along is not None:
            rows.append(_frequencies(self._even(along_the_field(residual, [terms]).made)) / self._root_along[:, None])
        if residual.sighted is not None:
            rows.append(across_directions(residual, [terms]).made)
        if not rows:
            return None
        columns, free = np.concatenate(rows), self._free_along
        left = columns - free @ (free.T @ columns)
        return _Along(left, np.sum(columns**2, axis=0) - np.sum(left**2, axis=0))

    def _add_across(self, across: _Across, score: Array, normal: Array) -> None:
        """Add what the values across say of the coefficients, weighted by the noise of each sensor in each band."""
        values = self._across / self._root_across[:, None]
        for (i, j), weight in zip(pairwise(self._edges), self._weights, strict=True):
            weighted, series = across.into @ weight, across.series[i:j]
            score += np.einsum("sko,so->k", weighted, series.T @ values[i:j])
            normal += np.einsum("sko,st,tlo->kl", weighted, series.T @ series, across.into, optimize=True)

    def _noise_of(self, across: _Across | None, along: _Along | None, seen: Array, count: int) -> tuple[Array, Array]:
        """(B, R, R) covariance of scores from each part of the noise, and (B,) how many values tell its level.

        Parameters
        ----------
        seen: (R, P or more) the scores, as sums of those of the terms, of which the first are `count`.
        """
        residual, edges = self.residual, self._edges
        n, sensors, each = edges[-1], len(residual.noise) // 3, np.diff(edges).astype(float)
        parts, counts, turned = [], [], None
        rows = None if along is None else along.rows @ seen[:, :count].T
        if rows is not None and residual.along is not None:
            turned = _course(rows[:n] / self._root_along[:, None])
            parts.append(_grams(rows[:n] * np.sqrt(self._reference / self._root_along**2)[:, None], edges))
            counts.append(each)
        if rows is not None and residual.sighted is not None:
            sighted = rows[-len(residual.sighted.residual) :]
            parts.append((sighted.T @ sighted)[None])
            counts.append(np.array([float(len(residual.sighted.residual))]))
        if residual.across is not None:
            of_output = np.zeros((3 * sensors, n, len(seen)))
            if turned is not None:
                for o, gain in enumerate(self._even(residual.gain).T):
                    of_output[o] += _frequencies(turned * gain[:, None]) * self._root_across[:, None]
            if across is not None:
                for (i, j), weight in zip(pairwise(edges), self._weights, strict=True):
                    through = np.einsum("rk,sko->osr", seen, across.into @ weight, optimize=True)
                    of_output[:, i:j] += across.series[i:j] @ through
            for own, levels in zip(of_output, self._levels.T, strict=True):
                parts.append(_grams(own, edges) * levels[:, None, None])
                counts.append(each * (sensors - 1) / sensors)
        return np.concatenate(parts), np.concatenate(counts)

    @cached_property
    def _between(self) -> Array | None:
        """(M,) numbers of samples, and where some are missing places between two of them; None where none are."""
        time = self.residual.time
        if time is None or len(time) < LEAST:
            return None
        steps = np.diff(time)
        missing = np.maximum(np.round(steps / np.median(steps)) - 1.0, 0.0)
        if not missing.any():
            return None
        missing = np.floor(missing * min(1.0, MOST_MISSING * len(time) / missing.sum())).astype(int)
        places = [i + np.arange(more + 1) / (more + 1) for i, more in enumerate(missing)]
        return np.concatenate([*places, [len(time) - 1.0]])

    def _even(self, series: Array) -> Array:
        """(M,) or (M, K): the values (N,) or (N, K) at an even rate, straight lines across gaps.

        Slow noise goes on in a gap, and would seem to have jumped if what comes after it followed at once.
        """
        if self._between is None:
            return series
        before = np.minimum(self._between.astype(int), len(series) - 2)
        part = (self._between - before).reshape(-1, *(1,) * (series.ndim - 1))
        out: Array = series[before] * (1.0 - part) + series[before + 1] * part
        return out

    @cached_property
    def _edges(self) -> NDArray[np.int_]:
        """(B + 1,) frequencies between which the noise of the sensors is compared."""
        n = len(self._even(self.residual.affine))
        octaves = BAND * 2 ** np.arange(max(int(np.log2(n)), 1))
        return np.concatenate([[0], octaves[octaves < n // 2], [n]])

    @cached_property
    def _across(self) -> Array:
        """(N, 3 S) the residual across, over frequency, without its mean."""
        assert self.residual.across is not None
        out = _frequencies(self._even(self.residual.across))
        out[0] = 0.0
        return out

    @cached_property
    def _root_across(self) -> Array:
        """(N,) root of its mean power, smoothed."""
        values = len(self.residual.noise) - 3
        return np.sqrt(smoothed_spectrum(np.sum(self._across**2, axis=1) / values))

    @cached_property
    def _levels(self) -> Array:
        """(B, 3 S) power of each output's noise over that of all, in each band."""
        each = _grams(self._across / self._root_across[:, None], self._edges)
        return _levels(each, np.diff(self._edges), self.residual.projector)

    @cached_property
    def _weights(self) -> Array:
        """(B, 3 S, 3 S) inverse covariance across of the sensors' noise in each band."""
        projector = self.residual.projector
        return _inverse(projector * self._levels[:, None] @ projector, 1e-9)

    @cached_property
    def _along(self) -> Array:
        """(N,) the residual along, over frequency."""
        assert self.residual.along is not None
        return _frequencies(self._even(self.residual.along))

    @cached_property
    def _root_along(self) -> Array:
        """(N,) root of its power, smoothed."""
        return np.sqrt(smoothed_spectrum(self._along**2))

    @cached_property
    def _values_along(self) -> Array:
        """(N,), or 2 N more of known directions: what the columns along are compared with."""
        residual, values = self.residual, []
        if residual.along is not None:
            values.append(self._along / self._root_along)
        if residual.sighted is not None:
            values.append(residual.sighted.residual)
        return np.concatenate(values)

    @cached_property
    def _free_along(self) -> Array:
        """(N or more, Q) orthonormal: what C and o can explain of these."""
        residual, rows = self.residual, []
        if residual.along is not None:
            rows.append(_frequencies(self._even(residual.inner)) / self._root_along[:, None])
        if residual.sighted is not None:
            rows.append(residual.sighted.inner)
        basis, size, _ = np.linalg.svd(np.concatenate(rows), full_matrices=False)
        out: Array = basis[:, size > _INNER_RANK * size[0]]
        return out

    @cached_property
    def _reference(self) -> Array:
        """(N,) power along the field that is not the sensors': all of it, but for the white noise of these."""
        power = self._root_along**2
        if self.residual.across is None:
            return power
        shown = np.mean(self.residual.gain**2, axis=0)
        white = float(shown @ self._levels[-1]) * float(self._root_across[-1] ** 2)
        return np.maximum(power - white, _LEAST_REFERENCE * power)


@dataclass(frozen=True)
class _Across:
    """Whitened series (N, K) over frequency, which P coefficients put into the outputs by (K, P, 3 S)."""

    series: Array
    into: Array


@dataclass(frozen=True)
class _Along:
    """Whitened columns (N or more, P), and what of the square of each C and o could do (P,)."""

    rows: Array
    alone: Array


def smoothed_spectrum(power: Array) -> Array:
    """Power (N,) over the cosine frequencies, smoothed over octaves; below the middle of the lowest it rises as it does
    above."""
    n = len(power)
    if n < LEAST:
        return np.full(n, max(float(np.mean(power[1:])), 1e-300))
    octaves = OCTAVE * 2 ** np.arange(int(np.log2(n)))
    edges = np.concatenate([[1], octaves[octaves < n // 2], [n]])
    place = np.log(np.arange(1, n))

    def means(values: Array) -> Array:
        return np.add.reduceat(values, edges[:-1] - 1) / np.diff(edges)

    level, middle = means(np.maximum(power[1:], 1e-300)), means(place)

    def between(course: Array) -> Array:
        values = np.interp(place, middle, course)
        slope = min((course[1] - course[0]) / (middle[1] - middle[0]), 0.0)
        return np.exp(values + slope * np.minimum(place - middle[0], 0.0))

    course = np.log(level)
    for _ in range(_SMOOTHING):
        course += np.log(level / means(between(course)))
    smooth = between(course)
    return np.concatenate([smooth[:1], smooth])


def _levels(squares: Array, counts: NDArray[np.int_], projector: Array) -> Array:
    """(B, 3 S), the likeliest power of each output's noise in whitened values across.

    First of each sensor, then of each of its axes, held to that of the sensor as by some values more of the same power.
    Two sensors have one contrast, which does not tell whose noise it is.

    Parameters
    ----------
    squares: (B, 3 S, 3 S) products of the values of each band; counts: (B,) how many it has.
    """
    outputs, sensors = len(projector), len(projector) // 3
    covariance = squares / counts[:, None, None]
    if sensors < 3:
        mean = np.trace(covariance, axis1=1, axis2=2) / (outputs - 3)
        return np.repeat(mean[:, None], outputs, axis=1)
    of_sensors = _scored(covariance, projector, np.ones((len(counts), outputs)), 3, np.ones(len(counts)))
    values = counts * (sensors - 1) / sensors
    return _scored(covariance, projector, of_sensors, 1, values / (values + ALIKE))


def _scored(covariance: Array, projector: Array, levels: Array, alike: int, weight: Array) -> Array:
    """Levels (B, 3 S), those of so many neighbours alike, by steps of scoring on the logarithms from those given, which
    count for the rest of the weight (B,); halved, the steps keep the levels positive and raise the likelihood."""
    first, weight = levels, weight[:, None]

    def of_neighbours(matrices: Array) -> Array:
        each = np.diagonal(matrices, axis1=1, axis2=2).reshape(len(levels), -1, alike)
        return np.repeat(each.sum(axis=2), alike, axis=1)

    for _ in range(_SCORING):
        inverse = _inverse(projector * levels[:, None] @ projector, 1e-9)
        seen, expected = of_neighbours(inverse @ covariance @ inverse), of_neighbours(inverse)
        likeliest = levels * np.sqrt(np.maximum(seen, 1e-12 * expected) / expected)
        levels = weight * likeliest + (1.0 - weight) * first
    return levels


def _frequencies(series: Array) -> Array:
    from scipy.fft import dct

    out: Array = dct(series, axis=0, norm="ortho")
    return out


def _course(spectrum: Array) -> Array:
    from scipy.fft import idct

    out: Array = idct(spectrum, axis=0, norm="ortho")
    return out


def _inverse(matrix: Array, least: float = 1e-10) -> Array:
    return np.asarray(np.linalg.pinv(matrix, rcond=least, hermitian=True), dtype=float)


def _grams(columns: Array, edges: NDArray[np.int_]) -> Array:
    """(B, P, P) products of the columns of (N, P) in each band."""
    return np.stack([columns[i:j].T @ columns[i:j] for i, j in pairwise(edges)])
