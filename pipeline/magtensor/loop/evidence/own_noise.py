"""How unlikely terms are in noise whose spectrum is each sensor's own, whatever its law.

The loop's working colours are one for all outputs, they are laws of frequency, and stationary in each of the residual's
two parts. None of that holds where one sensor is worse than the others, or a base station wanders beside the site. What
is asked here needs none of it: coefficients are linear in the noise of the outputs, so the power of each sensor's noise
at each frequency, as measured, gives their covariance, the working colours being no more than weights (the sandwich of
White 1980, over frequencies). Slow noise of a sensor shows across the plane and, turned with the platform, along the
field; what it does in both is added up before it is squared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.terms import REFERENCE, Terms, joined
from magtensor.loop.evidence.columns import across_directions, along_the_field
from magtensor.loop.evidence.estimate import Own, identifiable
from magtensor.loop.evidence.even_rate import EvenRate
from magtensor.loop.evidence.of_a_course import of_a_course
from magtensor.loop.evidence.one_series import in_octaves
from magtensor.loop.evidence.other_times import as_at_other_times
from magtensor.loop.evidence.residual import Residual, taken_off
from magtensor.loop.evidence.sensor_noise import (
    SensorNoise,
    bands,
    grams_in_bands,
    inverse_of,
    over_frequency,
    smoothed_spectrum,
)
from magtensor.loop.evidence.statistics import cauchy_combination, fisher_combination

NOT_ASKED = 0.05  # p value, from which on nobody asks how likely it is
LEAST_RESOLVED = 8  # frequencies, of the shortest surveys
_INNER_RANK = 1e-6  # of the largest singular value
_LEAST_SEEN = 1e-9  # of what is known of the best axis of a sensor, of the others
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

        Of one coefficient of the reference, and of one series that is added to outputs of the sensors, the exact law is
        known (`one_series`). Of the sensors it is asked in what differs between them: of each beside all others, which
        shows what one of them does, and of each beside those that are quieter: these are independent and are put
        together (Fisher 1925).
        """
        if terms.count == 1 and np.all(terms.part_output == REFERENCE) and self.residual.sighted is None:
            return self._of_one_in_the_reference(terms)
        if self.residual.across is None or not _one_series(terms):
            return self.by_score(terms)
        return cauchy_combination([self.by_score(terms), *self._of_one_series(terms)])

    def by_score(self, terms: Terms) -> float:
        """The same of any terms, by the score of their coefficients.

        The levels of the noise are those of all that is left, what the terms explain included, and known from few
        frequencies where they are slow. In one band what is explained is then a share of as many values as the level is
        known from (Satterthwaite 1946): beta-distributed, like the squared multiple correlation. Where bands of
        few and of many values come together that share has no bound of one, and would be far too unlikely; chi-square,
        as if the levels were known, errs to the other side in one band. The larger of both is taken.

        The slow noise of a single sensor is seen through its turning alone, and has no spectrum along the field: what
        it explains there is compared with what it does at other times (`other_times`).
        """
        from scipy.special import betaincc, chdtrc

        explained, rank, freedom = self.explained(terms)
        if freedom <= rank + 1.0:
            return 1.0
        share_of_all = min(explained / freedom, 1.0)
        found = max(float(betaincc(rank / 2.0, (freedom - rank) / 2.0, share_of_all)), float(chdtrc(rank, explained)))
        alone = len(self.residual.noise) == 3 and self.residual.sighted is None
        if not alone or not terms.adds_to_axes or found > NOT_ASKED:
            return found
        return max(found, as_at_other_times(explained / rank, rank, self._beside(terms).explained, terms))

    def _beside(self, terms: Terms) -> OwnNoise:
        """The noise of what terms leave, seen along the field, they being free as well."""
        assert self.residual.along is not None
        together = terms if self.given is None else joined([self.given, terms])
        columns, free = along_the_field(self.residual, [together]).made, self.residual.free_along
        theta = np.linalg.lstsq(columns - free @ (free.T @ columns), self.residual.along, rcond=_INNER_RANK)[0]
        return OwnNoise(taken_off(self.residual, together, np.asarray(theta, dtype=float)), together)

    def explained(self, terms: Terms) -> tuple[float, int, float]:
        """What terms explain beside the given ones, in how many directions, and from how many values its scale is
        known; 0 in none where they show in none."""
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
        others = self._free(normal, alone, every.count - terms.count, every.count)
        seen = np.zeros((len(tested), size))
        seen[:, tested] = np.eye(len(tested))
        seen -= normal[tested] @ others @ inverse_of(others.T @ normal @ others) @ others.T
        seen = identifiable(seen @ normal @ seen.T, Own(alone[tested], terms.noise_of_each)).T @ seen
        rank = len(seen)
        if not rank:
            return 0.0, 0, 0.0
        parts, counts = self._noise_of(across, along, seen, every.count)
        inverse = np.linalg.pinv(parts.sum(axis=0), hermitian=True)
        share = np.einsum("ij,bji->b", inverse, parts)
        found = seen @ score
        return float(found @ inverse @ found), rank, rank**2 / float(np.sum(share**2 / counts))

    def _free(self, normal: Array, alone: Array, given: int, terms: int) -> Array:
        """(P, q) directions of coefficients (P,) that are free: of the given ones those that the data show, and all of
        what the fit itself is free in, which comes after the terms.

        Parameters
        ----------
        normal: (P, P); alone: (terms,) information of each term, what the fit could do included.
        """
        fit = np.arange(terms, len(normal))
        own = np.zeros((len(normal), len(fit)))
        own[fit] = np.eye(len(fit))
        if self.given is None:
            return own
        among = normal[:given, fit]
        left = normal[:given, :given] - among @ inverse_of(normal[np.ix_(fit, fit)]) @ among.T
        basis = identifiable(left, Own(alone[:given], self.given.noise_of_each))
        shown = np.zeros((len(normal), basis.shape[1]))
        shown[:given] = basis
        return np.hstack([shown, own])

    def _of_one_in_the_reference(self, terms: Terms) -> float:
        """The same of a single coefficient that is seen in |b| - F alone, octave by octave, up to the frequencies that
        the readings of the base station resolve: beyond these its noise is what was drawn from one reading to the next,
        and has no independent values.
        """
        residual = self.residual
        if residual.along is None:
            return 1.0
        every = terms if self.given is None else joined([terms, self.given])
        columns = np.column_stack([residual.along, along_the_field(residual, [every]).made, residual.inner])
        units = residual.reference_gain if residual.levels is None else None
        return of_a_course(columns, units, self._even, self._resolved)

    def _of_one_series(self, terms: Terms) -> tuple[float, float]:
        """The same of a series that is added to outputs of sensors, by what differs between these: that any of them
        shows it beside the others, and that all do."""
        given = [] if self.given is None else [self.given.series]
        series = over_frequency(self._even(np.hstack([terms.series, self.residual.affine, *given])))
        series[0] = 0.0
        noise = self._sensors.without(series)
        narrow = noise.narrow()
        sensors, own = noise.from_quiet_to_noisy(), {int(s) for s in terms.part_output // 3}
        order = [s for s in sensors if s not in own] + [s for s in sensors if s in own]

        def beside(sensor: int, others: Sequence[int]) -> float:
            return self._of_one_sensor(terms, series, narrow, [sensor, *others])

        each = [beside(s, [o for o in order if o != s]) for s in sorted(own)]
        quieter = [beside(s, order[:k]) for k, s in enumerate(order) if s in own and k]
        return cauchy_combination(each), fisher_combination(quieter)

    def _of_one_sensor(
        self, terms: Terms, series: Array, narrow: Sequence[tuple[slice, Array]], sensors: Sequence[int]
    ) -> float:
        """The same of the first of some sensors, by what differs between it and the others.

        Parameters
        ----------
        series: (N, 1 + Q) over frequency, that of the terms and others that are free; narrow: bands with the power of
            the outputs in each.
        """
        outputs = np.concatenate([np.arange(3 * s, 3 * s + 3) for s in sensors])
        fit = 1 + self.residual.affine.shape[1]
        series = series[:, [*range(fit), *(fit + k for k in self._given_series_into(outputs))]]
        own = terms.part_output // 3 == sensors[0]
        into = np.zeros((terms.count, len(outputs)))
        axis = terms.part_output[own] % 3
        np.add.at(into, (terms.part_term[own], axis), terms.part_weight[own] / self.residual.noise[outputs[axis]])
        into = into[np.any(into != 0.0, axis=1)]
        seen = np.empty((len(series), len(into)))
        plane = self.residual.basis[outputs]
        for band, power in narrow:
            weight = np.diag(1.0 / power[outputs])
            weight -= weight @ plane @ np.linalg.solve(plane.T @ weight @ plane, plane.T @ weight)
            level, axes = np.linalg.eigh(into @ weight @ into.T)
            level = np.maximum(level, _LEAST_SEEN * level[-1])
            alike = (
                weight @ into.T @ axes / np.sqrt(level) @ axes.T
            )  # to directions in which noise is one, alike in all
            seen[band] = self._sensors.values[band][:, outputs] @ alike
            series[band] *= np.exp(0.5 * np.mean(np.log(level)))
        basis, size, _ = np.linalg.svd(series[:, 1:], full_matrices=False)
        taken = basis[:, size > _INNER_RANK * size.max(initial=0.0)]
        column, seen = (each - taken @ (taken.T @ each) for each in (series[:, 0], seen))
        if np.sum(column**2) <= _INNER_RANK**2 * np.sum(series[:, 0] ** 2):
            return 1.0
        return in_octaves(column, seen, taken)

    def _given_series_into(self, outputs: Array) -> list[int]:
        """The numbers of the given terms' series that are in some outputs: one in the reference alone is not."""
        if self.given is None:
            return []
        return sorted(set(self.given.part_series[np.isin(self.given.part_output, outputs)].tolist()))

    def slow_std(self) -> Array:
        """(3 S,) nT, rms of the slow noise of each output beside its white noise; 0 of a single sensor."""
        if self.residual.across is None:
            return np.zeros(len(self.residual.noise))
        each = np.diff(self._sensors.edges)
        power = np.repeat(self._sensors.levels, each, axis=0) * self._sensors.root[:, None] ** 2
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
        series = over_frequency(self._even(np.hstack([terms.series, residual.affine]))) / self._sensors.root[:, None]
        series[0] = 0.0
        return _Across(series, into)

    def _along_of(self, terms: Terms) -> _Along | None:
        """The columns of terms along the field, whitened, what C and o can do taken off."""
        residual, rows = self.residual, []
        if residual.along is not None:
            rows.append(over_frequency(self._even(along_the_field(residual, [terms]).made)) / self._root_along[:, None])
        if residual.sighted is not None:
            rows.append(across_directions(residual, [terms]).made)
        if not rows:
            return None
        columns, free = np.concatenate(rows), self._free_along
        left = columns - free @ (free.T @ columns)
        return _Along(left, np.sum(columns**2, axis=0) - np.sum(left**2, axis=0))

    def _add_across(self, across: _Across, score: Array, normal: Array) -> None:
        """Add what the values across say of the coefficients, weighted by the noise of each sensor in each band."""
        values = self._sensors.values / self._sensors.root[:, None]
        for (i, j), weight in zip(pairwise(self._sensors.edges), self._sensors.weights, strict=True):
            weighted, series = across.into @ weight, across.series[i:j]
            score += np.einsum("sko,so->k", weighted, series.T @ values[i:j])
            normal += np.einsum("sko,st,tlo->kl", weighted, series.T @ series, across.into, optimize=True)

    def _noise_of(self, across: _Across | None, along: _Along | None, seen: Array, count: int) -> tuple[Array, Array]:
        """(B, R, R) covariance of scores from each part of the noise, and (B,) how many values tell its level.

        Parameters
        ----------
        seen: (R, P or more) the scores, as sums of those of the terms, of which the first are `count`.
        """
        residual, edges = self.residual, bands(len(self._even(self.residual.affine)))
        n, sensors, each = edges[-1], len(residual.noise) // 3, np.diff(edges).astype(float)
        parts, counts, turned = [], [], None
        rows = None if along is None else along.rows @ seen[:, :count].T
        if rows is not None and residual.along is not None:
            turned = np.ascontiguousarray(_course(rows[:n] / self._root_along[:, None]).T)
            parts.append(grams_in_bands(rows[:n] * np.sqrt(self._reference / self._root_along**2)[:, None], edges))
            counts.append(each)
        if rows is not None and residual.sighted is not None:
            sighted = rows[-len(residual.sighted.residual) :]
            parts.append((sighted.T @ sighted)[None])
            counts.append(np.array([float(len(residual.sighted.residual))]))
        if residual.across is not None:
            of_output = np.zeros((3 * sensors, len(seen), n))
            if turned is not None:
                for o, gain in enumerate(self._even(residual.gain).T):
                    of_output[o] += over_frequency(turned * gain, axis=1) * self._sensors.root
            if across is not None:
                for (i, j), weight in zip(pairwise(edges), self._sensors.weights, strict=True):
                    through = np.einsum("rk,sko->ors", seen, across.into @ weight, optimize=True)
                    of_output[:, :, i:j] += through @ across.series[i:j].T
            for own, levels in zip(of_output, self._sensors.levels.T, strict=True):
                parts.append(grams_in_bands(own.T, edges) * levels[:, None, None])
                counts.append(each * (sensors - 1) / sensors)
        return np.concatenate(parts), np.concatenate(counts)

    @property
    def _resolved(self) -> int:
        """How many of the lowest frequencies the readings of the base station resolve."""
        residual = self.residual
        count = len(self._along)
        if residual.time is None or residual.reading_s <= 0:
            return count
        a_reading = residual.reading_s / float(np.median(np.diff(residual.time)))
        return max(int(count / max(a_reading, 1.0)), LEAST_RESOLVED)

    @cached_property
    def _rate(self) -> EvenRate | None:
        return EvenRate.of(self.residual.time)

    def _even(self, series: Array) -> Array:
        """(M,) or (M, K): the values (N,) or (N, K) at an even rate."""
        return series if self._rate is None else self._rate(series)

    @cached_property
    def _sensors(self) -> SensorNoise:
        """Of the residual across."""
        assert self.residual.across is not None
        values = over_frequency(self._even(self.residual.across))
        values[0] = 0.0
        return SensorNoise.of(values, self.residual.projector)

    @cached_property
    def _along(self) -> Array:
        """(N,) the residual along, over frequency."""
        assert self.residual.along is not None
        return over_frequency(self._even(self.residual.along))

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
            rows.append(over_frequency(self._even(residual.inner)) / self._root_along[:, None])
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
        white = float(shown @ self._sensors.levels[-1]) * float(self._sensors.root[-1] ** 2)
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


def _one_series(terms: Terms) -> bool:
    """Whether all coefficients add the same series to outputs, each to those of one sensor."""
    of_one = all(len(set(terms.part_output[terms.part_term == p] // 3)) == 1 for p in range(terms.count))
    return (
        of_one and terms.series.shape[1] == 1 and terms.delay is None and bool(np.all(terms.part_output != REFERENCE))
    )


def _course(spectrum: Array) -> Array:
    from scipy.fft import idct

    return np.asarray(idct(spectrum, axis=0, norm="ortho"))
