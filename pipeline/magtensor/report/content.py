"""What the page is made of: `result.nc` and `verdict.json` as read, with nothing taken for granted.

A group or variable that a run did not make is None here; who draws or tabulates it says so in words.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.errors import DataError
from magtensor.provenance import GROUP, Provenance
from magtensor.survey.model import Survey

if TYPE_CHECKING:
    from magtensor.calibration.coverage import Coverage

AGAIN = "run the recipe again to write it anew"
JUDGED = 20_000  # samples of a sensor: enough to see every cone of a few degrees
TIMED = ("calibrated", "residual", "detrended")


@dataclass(frozen=True)
class Content:
    """A result as the report sees it.

    Attributes:
        survey: the groups of `result.nc` as nodes.
        outcome: the content of `verdict.json`; None where the file is not there.
    """

    survey: Survey
    outcome: Mapping[str, Any] | None

    def variable(self, path: str) -> Array | None:
        """A numeric variable as float64 with NaN for what is not finite; None where the result has none."""
        if path not in self.survey:
            return None
        values = np.asarray(self.survey.values(path))
        if values.dtype.kind not in "fiub":
            return None
        numbers = values.astype(np.float64)
        numbers[~np.isfinite(numbers)] = np.nan
        return numbers

    def in_use(self, path: str) -> Array | None:
        """As `variable`, for one over time: NaN also where a sample is flagged."""
        values = self.variable(path)
        if values is not None:
            values[~self.good] = np.nan
        return values

    def names(self, path: str) -> list[str]:
        """A variable of names as text; empty where the result has none."""
        return [str(v) for v in np.asarray(self.survey.values(path)).ravel()] if path in self.survey else []

    def attributes(self, path: str) -> Mapping[str, Any]:
        """The attributes of a variable; none where the result does not have it."""
        return self.survey[path].attrs if path in self.survey else {}

    def listed(self, path: str, attribute: str) -> Any:
        """An attribute that holds JSON text, decoded; None where it is not there or is no JSON."""
        return decoded(self.attributes(path).get(attribute))

    @cached_property
    def time(self) -> Array:
        """(N,) s; empty where the result has nothing over time."""
        for group in TIMED:
            if (found := self.variable(f"{group}/time")) is not None:
                return found
        return np.empty(0)

    @cached_property
    def time_units(self) -> str:
        """`seconds since ...`, or nothing."""
        return next((str(u) for g in TIMED if (u := self.attributes(f"{g}/time").get("units"))), "")

    @cached_property
    def sensors(self) -> list[str]:
        """The sensors' names."""
        return next((s for g in (*TIMED, "calibration") if (s := self.names(f"{g}/sensor"))), [])

    @cached_property
    def good(self) -> np.ndarray:
        """(N,) samples in use; all where the result does not say."""
        if "calibrated/good" in self.survey:
            return np.asarray(self.survey.values("calibrated/good")).astype(bool)
        return np.ones(len(self.time), dtype=bool)

    @cached_property
    def coverage(self) -> list[Coverage | None]:
        """What the attitudes of each sensor can determine, judged from its calibrated field; None of fewer than ten
        samples, empty where the result has no field."""
        from magtensor.calibration.coverage import coverage, same_postures

        b = self.in_use("calibrated/b")
        if b is None or not b.size:
            return []
        found: dict[int, tuple[Coverage, Array]] = {}
        for i in range(b.shape[1]):
            known = b[np.isfinite(b[:, i]).all(axis=1), i]
            known = known[:: max(1, len(known) // JUDGED)]
            length = np.linalg.norm(known, axis=1)
            known, length = known[length > 0], length[length > 0]
            if len(known) >= 10:
                judged = coverage(known, length, matrix=np.eye(3), offset=np.zeros(3))
                found[i] = (judged, known / length[:, None])
        if not found:
            return [None] * b.shape[1]
        alone, unit = zip(*found.values(), strict=True)
        together = same_postures(alone, unit, np.tile(np.eye(3), (len(alone), 1, 1)))
        given = dict(zip(found, together, strict=True))
        return [given.get(i) for i in range(b.shape[1])]

    @cached_property
    def flags(self) -> list[dict[str, Any]]:
        """The flag record."""
        found = decoded(self.group_attributes("qc").get("flag_record"))
        return found if isinstance(found, list) else []

    def group_attributes(self, group: str) -> Mapping[str, Any]:
        """The attributes of a group; none where it is not there."""
        found = self.survey.tree[group].attrs if group in self.survey.tree.children else {}
        return {str(k): v for k, v in found.items()}

    @cached_property
    def provenance(self) -> Provenance | None:
        """Where the result comes from; None where the file does not say."""
        attributes = self.group_attributes(GROUP)
        return Provenance.from_attributes(attributes) if attributes else None

    @cached_property
    def frame(self) -> str:
        """The frame of the calibrated field, as the calibration words it."""
        return str(self.attributes("calibration/matrix").get("frame", ""))

    @cached_property
    def noise_of_axes(self) -> Array:
        """(S, 3) nT white noise of each axis, as stored or else found from the calibrated field; NaN where unknown."""
        from magtensor.calibration.noise import noise_std

        stored, b = self.variable("calibration/noise_std"), self.in_use("calibrated/b")
        if stored is not None or b is None:
            return stored if stored is not None else np.full((len(self.sensors), 3), np.nan)
        residual = self.in_use("residual/total_field")
        if residual is not None:  # sensor by sensor: they need not share a frame
            found = np.full(b.shape[1:], np.nan)
            for i in range(b.shape[1]):
                known = np.isfinite(b[:, i]).all(axis=1) & np.isfinite(residual[:, i])
                field = b[known, i : i + 1]
                found[i] = noise_std(field, np.linalg.norm(field[:, 0], axis=1) - residual[known, i])
            return found
        whole = np.isfinite(b).all(axis=(1, 2))
        return noise_std(b[whole]) if "residual/contrast" in self.survey else np.full(b.shape[1:], np.nan)

    @cached_property
    def noise(self) -> Array:
        """(S,) nT noise of each sensor, rms over its axes; NaN where one is unknown."""
        return np.asarray(np.sqrt(np.mean(self.noise_of_axes**2, axis=1)))


def decoded(text: Any) -> Any:
    """JSON text decoded; None where it is no such thing."""
    if not isinstance(text, str):
        return None
    try:
        return json.loads(text)
    except ValueError:
        return None


def read(directory: Path) -> Content:
    """The results of a run.

    Raises:
        DataError: `result.nc` is missing or cannot be read, or `verdict.json` is no verdict.
    """
    from magtensor.result import RESULT, VERDICT, open_result

    survey = open_result(Path(directory) / RESULT)
    path = Path(directory) / VERDICT
    if not path.is_file():
        return Content(survey, None)
    try:
        outcome = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DataError(f"is no JSON: {error}", where=str(path), hint=AGAIN) from error
    if not (isinstance(outcome, dict) and isinstance(outcome.get("error"), dict)):
        raise DataError("is no verdict: it has no `error`", where=str(path), hint=AGAIN)
    return Content(survey, outcome)
