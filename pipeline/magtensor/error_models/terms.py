"""Regressors: what a unit of each coefficient adds to the raw outputs, or to the reference."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array

REFERENCE = -1  # the output number of the reference total field


@dataclass(frozen=True)
class Terms:
    """P coefficients and their regressors, stored without repeating a series that several outputs share.

    Attributes:
        names: (P,) the coefficient's name within its sensor ("x", "xy").
        sensors: (P,) the sensor's name, "" for one shared by all or of the reference.
        units: (P,) of the coefficient.
        series: (N, K) distinct regressors, nT per unit of the coefficient.
        part_term, part_output, part_series, part_weight: (Q,) each part adds coefficient times series times weight to
            an output, numbered 3 * sensor + axis, or REFERENCE; all weights are 1 where none are given.
        delay: (N, K) s by which a unit of the coefficient makes outputs late, of which the series is what that adds to
            first order, of weight 1; None where series are added as they are.
        noise: (K,) part of the variance of each series that says nothing: noise of the outputs, seen in the field, or
            what a law leaves open; 0 where not given.
    """

    names: tuple[str, ...]
    sensors: tuple[str, ...]
    units: tuple[str, ...]
    series: Array
    part_term: NDArray[np.int_]
    part_output: NDArray[np.int_]
    part_series: NDArray[np.int_]
    delay: Array | None = None
    part_weight: Array = field(default_factory=lambda: np.zeros(0))
    noise: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not len(self.part_weight):
            object.__setattr__(self, "part_weight", np.ones(len(self.part_term)))
        if len(self.noise) != self.series.shape[1]:
            object.__setattr__(self, "noise", np.zeros(self.series.shape[1]))

    @property
    def count(self) -> int:
        """P."""
        return len(self.names)

    def contribution(self, coefficients: Array, outputs: int) -> Array:
        """(N, outputs) nT that the coefficients (P,) add to the raw outputs, of a delay to first order."""
        return self._on_outputs(self.series, coefficients, outputs)

    def lateness(self, coefficients: Array, outputs: int) -> Array | None:
        """(N, outputs) s by which the coefficients (P,) make the raw outputs late; None of what is no delay."""
        return None if self.delay is None else self._on_outputs(self.delay, coefficients, outputs)

    def _on_outputs(self, series: Array, coefficients: Array, outputs: int) -> Array:
        weights = np.zeros((series.shape[1], outputs))
        raw = self.part_output >= 0
        each = self.part_weight[raw] * coefficients[self.part_term[raw]]
        np.add.at(weights, (self.part_series[raw], self.part_output[raw]), each)
        out: Array = series @ weights
        return out

    def on_reference(self, coefficients: Array) -> Array:
        """(N,) nT that the coefficients add to the reference total field."""
        weights = np.zeros(self.series.shape[1])
        own = self.part_output == REFERENCE
        np.add.at(weights, self.part_series[own], self.part_weight[own] * coefficients[self.part_term[own]])
        out: Array = self.series @ weights
        return out

    def at(self, samples: NDArray[np.int_]) -> Terms:
        """The same at some of the samples."""
        delay = None if self.delay is None else self.delay[samples]
        return replace(self, series=self.series[samples], delay=delay)

    @property
    def kind(self) -> Hashable:
        """What is the same of terms that differ in their series only, names and units apart."""
        return self.series.shape, *(place.tobytes() for place in _places(self))

    @property
    def adds_to_axes(self) -> bool:
        """Whether every series is added to all axes of a sensor alike, or to the reference: what turns with the field
        is another one in each axis."""
        if not np.all(self.part_weight == 1.0):
            return False
        raw = self.part_output != REFERENCE
        touched = {*zip(self.part_series[raw].tolist(), self.part_output[raw].tolist(), strict=True)}
        return all((s, 3 * (o // 3) + axis) in touched for s, o in touched for axis in range(3))

    def only(self, keep: Iterable[int]) -> Terms:
        """The terms of these numbers, in this order, with the series that they have."""
        order = list(keep)
        place = {old: new for new, old in enumerate(order)}
        parts = [i for i, t in enumerate(self.part_term) if int(t) in place]
        used, which = np.unique(self.part_series[parts], return_inverse=True)
        return Terms(
            tuple(self.names[i] for i in order),
            tuple(self.sensors[i] for i in order),
            tuple(self.units[i] for i in order),
            self.series[:, used],
            np.array([place[int(self.part_term[i])] for i in parts], dtype=int),
            self.part_output[parts],
            which.astype(int),
            None if self.delay is None else self.delay[:, used],
            self.part_weight[parts],
            self.noise[used],
        )

    @property
    def noise_of_each(self) -> Array:
        """(P,) part of the variance of each term that is noise: of its series, on average."""
        weight = self.part_weight**2
        total = np.bincount(self.part_term, weight, minlength=self.count)
        share = np.bincount(self.part_term, weight * self.noise[self.part_series], minlength=self.count)
        out: Array = share / np.maximum(total, 1e-300)
        return out

    @property
    def unweighted(self) -> Terms:
        """The same with a series for each part."""
        order = np.arange(len(self.part_term))
        series = self.series[:, self.part_series] * self.part_weight
        delay = None if self.delay is None else self.delay[:, self.part_series]
        return replace(
            self, series=series, part_series=order, delay=delay, part_weight=np.ones(len(order)),
            noise=self.noise[self.part_series],
        )  # fmt: skip


def stacked(parts: Sequence[Terms]) -> Terms:
    """The terms of one model on several surveys, whose samples are put after each other.

    Raises
    ------
    ValueError: the coefficients are not the same on all of them.
    """
    if not all(np.array_equal(part.part_weight, parts[0].part_weight) for part in parts[1:]):
        parts = [part.unweighted for part in parts]
    first = parts[0]
    for part in parts[1:]:
        same = all(np.array_equal(a, b) for a, b in zip(_places(first), _places(part), strict=True))
        if not same or (part.names, part.sensors, part.units) != (first.names, first.sensors, first.units):
            told = [
                ", ".join(dict.fromkeys(f"{n} {u}" for n, u in zip(p.names, p.units, strict=True)))
                for p in (first, part)
            ]
            raise ValueError(f"its coefficients are {told[0]} on one survey and {told[1]} on another")
    delays = [p.delay for p in parts if p.delay is not None]
    delay = np.concatenate(delays) if delays else None
    return replace(first, series=np.concatenate([p.series for p in parts]), delay=delay)


def _places(terms: Terms) -> tuple[NDArray[np.int_] | Array, ...]:
    return terms.part_term, terms.part_output, terms.part_series, terms.part_weight


def joined(parts: list[Terms]) -> Terms:
    """All terms of several models, one after the other, each to first order."""
    if len(parts) == 1:
        return parts[0]
    terms = np.cumsum([0, *(p.count for p in parts)])
    series = np.cumsum([0, *(p.series.shape[1] for p in parts)])
    return Terms(
        tuple(n for p in parts for n in p.names),
        tuple(s for p in parts for s in p.sensors),
        tuple(u for p in parts for u in p.units),
        np.hstack([p.series for p in parts]),
        np.concatenate([p.part_term + terms[i] for i, p in enumerate(parts)]),
        np.concatenate([p.part_output for p in parts]),
        np.concatenate([p.part_series + series[i] for i, p in enumerate(parts)]),
        part_weight=np.concatenate([p.part_weight for p in parts]),
        noise=np.concatenate([p.noise for p in parts]),
    )
