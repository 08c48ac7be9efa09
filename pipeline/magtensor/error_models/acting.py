"""The few ways in which effects act on sensors: what of their outputs a coefficient moves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.types import Array
from magtensor.error_models.terms import REFERENCE, Terms

AXES = "xyz"


class Acting(ABC):
    """Terms of a survey: N samples of S sensors.

    Attributes:
        time: (N,) s; sensors: names; output, field: (N, S, 3) nT; matrix: (S, 3, 3) C; as in `Excitation`.
    """

    if TYPE_CHECKING:

        @property
        def time(self) -> Array: ...

        @property
        def sensors(self) -> tuple[str, ...]: ...

        @property
        def output(self) -> Array: ...

        @property
        def field(self) -> Array: ...

        @property
        def matrix(self) -> Array: ...

        @property
        def rate(self) -> Array: ...

    @abstractmethod
    def sensed(self, vectors: Array) -> Array:
        """(N, S, 3): what the sensors make of a vector (N, 3), or one for each sensor."""

    def offsets(self, series: Array, units: str, name: str = "") -> Terms:
        """A series (N,), or one for each sensor (N, S), added to every axis: one coefficient an axis."""
        columns = np.asarray(series, dtype=float).reshape(len(self.time), -1)
        shared = columns.shape[1] == 1
        outputs = np.arange(3 * len(self.sensors))
        return self._single(columns, outputs, np.zeros_like(outputs) if shared else outputs // 3, units, name)

    def driving(self, of_field: bool) -> Array:
        """(N, S, 3) nT: the outputs, or what is in them of the field, without the offsets.

        A feedback resistor that warms scales the field and the hard iron; the offset of the electronics comes after it.
        """
        return self.sensed(self.field) if of_field else self.output

    def scales(self, series: Array, units: str, name: str = "", *, of_field: bool = False) -> Terms:
        """A series (N,) or (N, S) times the axis's own output, or the field in it: one coefficient an axis."""
        factor = np.asarray(series, dtype=float).reshape(len(self.time), -1, 1)
        return self.responses(self.driving(of_field) * factor, units, name)

    def responses(self, series: Array, units: str, name: str = "") -> Terms:
        """A series for each axis of each sensor, (N, S, 3): one coefficient an axis."""
        columns = np.asarray(series, dtype=float).reshape(len(self.time), -1)
        outputs = np.arange(columns.shape[1])
        return self._single(columns, outputs, outputs, units, name)

    def matrices(self, series: Array, units: str) -> Terms:
        """A vector (N, 3), or one for each sensor (N, S, 3), that reaches every axis through a matrix: nine each."""
        s = len(self.sensors)
        values = np.asarray(series, dtype=float)
        shared = values.ndim == 2
        columns = values.reshape(len(self.time), -1)
        outputs = np.repeat(np.arange(3 * s), 3)
        component = np.tile(np.arange(3), 3 * s)
        index = component if shared else 3 * (outputs // 3) + component
        names = tuple(AXES[o % 3] + AXES[c] for o, c in zip(outputs, component, strict=True))
        return Terms(
            names, tuple(self.sensors[o // 3] for o in outputs), (units,) * len(names), columns,
            np.arange(len(names)), outputs, index,
        )  # fmt: skip

    def one_each(self, series: Array, units: str, name: str) -> Terms:
        """A vector for each sensor (N, S, 3) with one coefficient a sensor."""
        s = len(self.sensors)
        columns = np.asarray(series, dtype=float).reshape(len(self.time), -1)
        outputs = np.arange(3 * s)
        return Terms((name,) * s, self.sensors, (units,) * s, columns, outputs // 3, outputs, outputs)

    def one_each_sensing(
        self, course: Array, vectors: Array, units: str, name: str, axes: Array | None = None
    ) -> Terms:
        """What sensors see of a vector (N, 3), or one for each sensor (N, S, 3), times a course (N,), or that of each
        sensor (N, S): one coefficient a sensor. `axes` (3, 3): how each axis shows what all three see."""
        columns, outputs, index, weights = self._sensing(course, vectors, axes)
        names, units_ = (name,) * len(self.sensors), (units,) * len(self.sensors)
        return Terms(names, self.sensors, units_, columns, outputs // 3, outputs, index, part_weight=weights)

    def shared_sensing(self, course: Array, vectors: Array, units: str, name: str) -> Terms:
        """The same with one coefficient for all sensors."""
        columns, outputs, index, weights = self._sensing(course, vectors, None)
        return Terms((name,), ("",), (units,), columns, np.zeros_like(outputs), outputs, index, part_weight=weights)

    def _sensing(
        self, course: Array, vectors: Array, axes: Array | None
    ) -> tuple[Array, NDArray[np.int_], NDArray[np.int_], Array]:
        """Series, and of the parts that make of them what sensors see the outputs, series and weights."""
        one = course.ndim == 1 and vectors.ndim == 2
        of_each = vectors if vectors.ndim == 3 else vectors[:, None]
        columns = (course.reshape(len(course), -1, 1) * of_each).reshape(len(course), -1)
        outputs = np.repeat(np.arange(3 * len(self.sensors)), 3)
        component = np.tile(np.arange(3), 3 * len(self.sensors))
        weights = self.matrix if axes is None else axes @ self.matrix
        return columns, outputs, component if one else 3 * (outputs // 3) + component, weights.reshape(-1)

    def late(self, course: Array, units: str, name: str, *, per_axis: bool = False) -> Terms:
        """Outputs late by a coefficient times a course (N,), s: one coefficient a sensor, or one an axis."""
        series = -np.asarray(course, dtype=float)[:, None, None] * self.sensed(self.rate)
        terms = self.responses(series, units, f"{name} ") if per_axis else self.one_each(series, units, name)
        return replace(terms, delay=np.repeat(course[:, None], terms.series.shape[1], axis=1))

    def shared(self, series: Array, units: str, name: str) -> Terms:
        """One coefficient for a pattern (N, S, 3) over all sensors."""
        columns = np.asarray(series, dtype=float).reshape(len(self.time), -1)
        outputs = np.arange(columns.shape[1])
        return Terms((name,), ("",), (units,), columns, np.zeros_like(outputs), outputs, outputs)

    def on_reference(self, series: Array, units: str, name: str) -> Terms:
        """One coefficient for a series (N,) that the reference total field holds."""
        columns, index = np.asarray(series, dtype=float)[:, None], np.zeros(1, dtype=int)
        return Terms((name,), ("",), (units,), columns, index, index + REFERENCE, index)

    def _single(
        self, columns: Array, outputs: NDArray[np.int_], index: NDArray[np.int_], units: str, name: str
    ) -> Terms:
        return Terms(
            tuple(f"{name}{AXES[o % 3]}" for o in outputs),
            tuple(self.sensors[o // 3] for o in outputs),
            (units,) * len(outputs),
            columns,
            np.arange(len(outputs)),
            outputs,
            index,
        )
