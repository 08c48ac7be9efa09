"""What a calibration that leans on a prior leaves open, in figures and in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .joint import JointFit, Posterior
from .known import Known
from .nominal import Nominal
from .types import PARAMETERS_PER_SENSOR, Array

BY_THE_PRIOR = 0.5  # of the prior's variance: a combination that keeps more is nominal rather than measured
AS_WELL = 2.0  # times the error in the directions seen: no direction is worse where the attitudes are enough
NAMED = 3  # parameters of a sensor, those that are known worst
_GAUGE = 3


@dataclass(frozen=True)
class Parameter:
    """What is known of one parameter: standard deviation with the data, and before them; units "1" or "nT"."""

    sensor: str
    name: str
    std: float
    assumed_std: float
    units: str

    def __str__(self) -> str:
        return f"{self.name} to {self.std:.2g} nT" if self.units == "nT" else f"{self.name} to {100 * self.std:.2g} %"


@dataclass(frozen=True)
class Undetermined:
    """A calibration whose attitudes did not determine it.

    Attributes:
        why: the refusal of the fit without a prior.
        nominal: the prior.
        combinations, of: how many combinations of the parameters the prior determines rather than the data, and how
            many there are.
        total_field: what |b| is known to.
        parameters: all of them, sensor after sensor.
        further: the postures that would help most.
    """

    why: str
    nominal: Nominal
    combinations: int
    of: int
    total_field: Known
    parameters: tuple[Parameter, ...]
    further: str

    @property
    def determined(self) -> bool:
        """Whether the attitudes are enough all the same: what is flagged now had spoilt the fit without a prior."""
        return not self.combinations and self.total_field.worst <= AS_WELL * self.total_field.seen

    @property
    def sentence(self) -> str:
        """For the terminal and the report."""
        known = self.total_field.words
        if self.determined:
            return (
                f"without sensors that are taken near nominal ({self.nominal}) there was no fit ({self.why}), but the "
                f"attitudes determine the calibration: {known}"
            )
        said = (
            f"the attitudes do not determine the calibration: sensors are taken near nominal ({self.nominal}); {known}"
        )
        if self.combinations:
            said += (
                f"; {self.combinations} of {self.of} combinations of scale factors, axis directions and offsets are "
                "known no better than was assumed"
            )
        return said

    @property
    def words(self) -> tuple[str, ...]:
        """What is known worst of each sensor, and what would help."""
        said = []
        for sensor in dict.fromkeys(p.sensor for p in self.parameters):
            own = sorted((p for p in self.parameters if p.sensor == sensor), key=lambda p: -p.std / p.assumed_std)
            said.append(f"{sensor} near nominal: {', '.join(str(p) for p in own[:NAMED])}")
        if self.further:
            said.append(f"what would help most is {self.further}")
        return tuple(said)

    def facts(self) -> dict[str, Any]:
        """For `verdict.json`."""
        return {
            "determined": self.determined,
            "description": self.sentence,
            "why": self.why,
            "assumed": {
                "scale_std": self.nominal.scale,
                "angle_std_deg": self.nominal.angle_deg,
                "offset_std_of_F": self.nominal.offset,
            },
            "combinations_by_prior": self.combinations,
            "combinations": self.of,
            "total_field_std_nT": self.total_field.facts(),
            "parameters": [
                {"sensor": p.sensor, "name": p.name, "std": p.std, "assumed_std": p.assumed_std, "units": p.units}
                for p in self.parameters
            ],
            "further_attitudes": self.further,
        }


def undetermined(fit: JointFit, nominal: Nominal, sensors: Sequence[str], total_field: Known, why: str) -> Undetermined:
    """What a fit with a prior leaves open.

    Parameters
    ----------
    total_field: what |b| is known to.
    why: the refusal of the fit without a prior.
    """
    known = fit.posterior
    assert known is not None
    std, assumed = (np.sqrt(np.maximum(np.diag(c), 0.0)) for c in (known.covariance, known.prior))
    names = [
        *(f"scale {i}" if i == j else f"{i} output's part along {j}" for i in "xyz" for j in "xyz"),
        *(f"offset {i}" for i in "xyz"),
    ]
    units = ["1"] * 9 + ["nT"] * 3
    size = PARAMETERS_PER_SENSOR
    parameters = tuple(
        Parameter(sensor, name, float(std[size * s + k]), float(assumed[size * s + k]), unit)
        for s, sensor in enumerate(sensors)
        for k, (name, unit) in enumerate(zip(names, units, strict=True))
    )
    share = _shares(known)
    further = str(fit.coverage.further)
    return Undetermined(why, nominal, int(np.sum(share > BY_THE_PRIOR)), len(share), total_field, parameters, further)


def _shares(known: Posterior) -> Array:
    """The variance that the prior's combinations keep, as parts of what they had; the common rotation left out."""
    scale = np.sqrt(np.maximum(np.diag(known.prior), 1e-300))
    values, vectors = np.linalg.eigh(known.prior / np.outer(scale, scale))
    root = vectors[:, _GAUGE:] / np.sqrt(values[_GAUGE:])
    out: Array = np.linalg.eigvalsh(root.T @ (known.covariance / np.outer(scale, scale)) @ root)
    return out
