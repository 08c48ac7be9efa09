"""Declared effects beside C and o, from surveys to what was fitted and to a survey's variables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from magtensor import DataError
from magtensor.components import Component
from magtensor_stages import joint_surveys

if TYPE_CHECKING:
    from magtensor.calibration.surveys.samples import Samples
    from magtensor.effect_errors import WithCoefficients
    from magtensor.loop.fitting.model import Adopted, Record
    from magtensor.loop.fitting.several import SurveysState
    from magtensor.survey.model import Survey

Chosen = Mapping[str, tuple[Component, Mapping[str, Any]]]
TONE_OF_SEVERAL = (
    "the error model {} has a phase of its own in every survey, where coefficients are common to all of them"
)
NO_REFERENCE = "the error model {} is of the reference, and this fit has no measured total field"


@dataclass(frozen=True)
class Effects:
    """Declared effects that were fitted.

    Attributes:
        adopted: the error models; theta: the coefficients of each; origins: of the channels, which were taken off.
        found: the calibration with the joint covariance.
    """

    adopted: Sequence[Adopted]
    theta: Sequence[np.ndarray]
    origins: Mapping[str, np.ndarray]
    found: WithCoefficients

    def variables(self, survey: Survey) -> dict[str, Any]:
        """The effects, and the joint covariance, as variables of the group `calibration`."""
        from magtensor.effect_errors import coefficient_variables
        from magtensor.loop.correcting.stored import effect_variables

        own = effect_variables(self.adopted, self.theta, self.origins, survey)
        return own | coefficient_variables(self.found, survey.sensors)

    def cleaned(self, survey: Survey) -> Survey:
        """A survey with the effects taken off."""
        from magtensor.loop.correcting.stored import cleaned

        return cleaned(survey, self.found.calibration, self.adopted, self.theta, self.origins)


def surveys_fitted(
    surveys: Sequence[tuple[str, Survey]],
    uses: Sequence[np.ndarray],
    samples: Samples,
    field: joint_surveys.Field,
    chosen: Chosen,
    options: Mapping[str, Any],
) -> tuple[SurveysState, Mapping[str, np.ndarray]]:
    """C, the offsets and the coefficients of effects, fitted together, and the origins of the channels.

    Raises:
        DataError: an error model needs what a survey does not show, or makes no sense in this fit.
    """
    from magtensor.loop.correcting.stored import begun_with, started
    from magtensor.loop.fitting.model import as_declared
    from magtensor.loop.fitting.several import Together, surveys_state

    first = surveys[0][1]
    adopted = as_declared(chosen.values(), first.time)
    measured = field.measured and all(joint_surveys.has_measured_size(one) for _, one in surveys)
    _require_sense(adopted, measured, len(surveys))
    records = _records(surveys, uses, measured)
    for (name, _), record in zip(surveys, records, strict=True):
        _require_needs(adopted, record, name)
    clocks = [adopted, *(begun_with(adopted, started(first), one) for _, one in surveys[1:])]
    conventional = not field.measured and field.declared is None
    return surveys_state(Together(samples, records, clocks, options, conventional)), records[0].origins


def _records(surveys: Sequence[tuple[str, Survey]], uses: Sequence[np.ndarray], measured: bool) -> list[Record]:
    """Of each survey, the origins of the first one's channels taken off all of them."""
    from magtensor.loop.fitting.record import record_of

    records = [record_of(surveys[0][1], use=uses[0])]
    for (_, one), use in zip(surveys[1:], uses[1:], strict=True):
        records.append(record_of(one, records[0].origins, use=use))
    each = {n: np.concatenate([r.logged[n] for r in records if n in r.logged]) for n in records[0].logged}
    changing = [n for n, values in each.items() if np.ptp(values, axis=0).max(initial=0.0) > 0]
    if not measured:
        records = [replace(r, total_field=None, quiet_field=None) for r in records]
    return [replace(r, logged={n: v for n, v in r.logged.items() if n in changing}) for r in records]


def _require_sense(adopted: Sequence[Adopted], measured: bool, surveys: int) -> None:
    from magtensor.loop.correcting.another_survey import TONE

    for one in adopted:
        if one.component.effect == "reference" and not measured:
            raise DataError(NO_REFERENCE.format(one.name), hint="leave it out, or measure the total field")
        if one.name == TONE and surveys > 1:
            raise DataError(TONE_OF_SEVERAL.format(one.name), hint="leave it out, or calibrate one survey")


def _require_needs(adopted: Sequence[Adopted], record: Record, where: str) -> None:
    from magtensor.error_models.needs import missing

    for one in adopted:
        if lacking := missing(one.component, record.excitation(record.raw, record.raw)):
            needs = " and ".join(lacking)
            raise DataError(f"the error model {one.name} needs {needs}, which this survey does not show", where=where)
