"""Declared error models beside C and o of one survey or several, with what is known of the field.

As `refit.joint_state`, which the search uses: for given coefficients C, o and the unknown constants of the field are
the fit of outputs and total field with the effects taken off (`calibration.surveys`); the coefficients then move by a
step in which all of these are free. Coefficients are common to all surveys, whose residuals, put after each other, are
one series: its noise has one colour, whose slow part follows from its middle frequencies, as what the coefficients took
away there is not to be missed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magtensor.calibration.by_sensor import by_sensor
from magtensor.calibration.common_scale import nominal
from magtensor.calibration.maximum_likelihood import along
from magtensor.calibration.surveys.directions import across
from magtensor.calibration.surveys.fit import SurveysFit, fit_surveys, frame_of, whitened
from magtensor.calibration.surveys.samples import Samples
from magtensor.calibration.types import Array
from magtensor.error_models.delays import cleared
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.terms import REFERENCE, Terms, joined, stacked
from magtensor.errors import DataError, NotEnoughData
from magtensor.loop.evidence.assessment import Colours, colours_of, estimated
from magtensor.loop.evidence.estimate import Estimate
from magtensor.loop.evidence.residual import Levels, Residual, Sighted
from magtensor.loop.evidence.stretches import borne_out_in
from magtensor.loop.evidence.turned import SlowModes, TurnedColour
from magtensor.loop.fitting.model import Adopted, Record
from magtensor.loop.fitting.refit import MOST_ROUNDS, move_of, small
from magtensor.loop.fitting.seen import beside_the_site

LEAST_LEFT = 8  # values along the field beyond the parameters: of fewer the noise is not known


@dataclass(frozen=True)
class Together:
    """What is fitted.

    Attributes:
        samples: of K surveys; records: of each, the same samples.
        adopted: the error models on the clock of each survey.
        options: of `fit_surveys`.
        nominal: the scale of the field is a convention, that of a nominal mean sensitivity.
    """

    samples: Samples
    records: Sequence[Record]
    adopted: Sequence[Sequence[Adopted]]
    options: Mapping[str, Any]
    nominal: bool = False


@dataclass(frozen=True)
class SurveysState:
    """Surveys with error models, fitted.

    Attributes:
        adopted: the error models, on the clock of the first survey; theta: coefficients of each.
        fit: C and the offsets; samples: it was made from, the effects taken off.
        residual: what is left; terms: of all models at its samples; estimate: of all coefficients together.
    """

    adopted: tuple[Adopted, ...]
    theta: tuple[Array, ...]
    fit: SurveysFit
    samples: Samples
    residual: Residual
    terms: Terms
    estimate: Estimate


def surveys_state(of: Together) -> SurveysState:
    """Fit C, the offsets and every coefficient together.

    Raises
    ------
    NotEnoughData, DataError: as in `fit_surveys`; an error model whose coefficients are others on another survey.
    """
    samples, theta = of.samples, np.zeros(0)
    parts: list[Array] = []
    lasting = True
    for _ in range(2 * MOST_ROUNDS):
        fit, more = _fitted(of, samples, lasting)
        each = _terms(of, samples, fit, parts)
        residual = residual_of_surveys(fit, samples)
        terms = joined(each).at(residual.samples)
        _require_enough(residual, terms, fit)
        colours = colours_of(residual, stiff=True)
        estimate = estimated(residual, terms, _beside_what_is_free(colours, residual, terms.count))
        before = theta if len(theta) else np.zeros(terms.count)
        move = move_of(residual, terms, estimate, colours, fresh=not before.any())
        theta = estimate.seen(before) + move  # what no data show stays zero
        parts = np.split(theta, np.cumsum([e.count for e in each])[:-1])
        samples = _without(of, each, parts)
        if small(theta - before, estimate):
            if not more:
                break
            lasting = False
    fit = fit_surveys(samples, **of.options)
    residual = residual_of_surveys(fit, samples)
    terms = joined(_terms(of, samples, fit, parts)).at(residual.samples)
    return SurveysState(tuple(of.adopted[0]), tuple(parts), fit, samples, residual, terms, estimate)


def _require_enough(residual: Residual, terms: Terms, fit: SurveysFit) -> None:
    """Refuse samples that the parameters follow one by one, so that nothing is left to tell their noise by."""
    own = terms.part_output != REFERENCE
    columns = min(3 * len(np.unique(terms.part_series[own])) + int((~own).sum()), terms.count)
    data, count = fit.data, len(residual.affine)
    constants = 0 if data.level is None else len(np.unique(data.level))
    free = (6 + 3 * data.centres if data.sighting is None else 3 + data.centres) + constants
    if count - free - columns < LEAST_LEFT:
        raise NotEnoughData(
            f"{count} samples are too few for C, o and {terms.count} coefficients of error models: along the field "
            f"they have {free + columns} parameters to follow",
            hint=f"declare fewer error models, or take {free + columns + LEAST_LEFT} samples in as many postures",
        )


def _fitted(of: Together, samples: Samples, lasting: bool) -> tuple[SurveysFit, bool]:
    """The fit of samples whose effects may not be all taken off yet, and whether it believes samples for it.

    Parameters
    ----------
    lasting: what noise does not explain is believed where it lasts (`stretches`): an effect of which the coefficients
        are not known yet, such as a jump shortly before the end.
    """
    fit = fit_surveys(samples, **of.options, complete=False)
    if not lasting or fit.keep.all():
        return fit, False
    keep = borne_out_in(fit.keep, [(freedom, np.nan_to_num(part)) for freedom, part in whitened(fit, samples)])
    if np.array_equal(keep, fit.keep):
        return fit, False
    return fit_surveys(samples, **of.options, complete=False, keep=keep), True


def residual_of_surveys(fit: SurveysFit, samples: Samples) -> Residual:
    """The residual of a fit of surveys at the samples it kept.

    Parameters
    ----------
    samples: that the fit was made from.
    """
    used, data = samples.at(fit.keep), fit.data
    matrix, basis, total_field = fit.found.matrix, fit.plane.basis, fit.found.sums.total_field
    b = data.fields(matrix, fit.found.centres)
    seen = along(matrix, np.zeros(3), (b @ np.linalg.inv(matrix).T).T, total_field, data.reference_noise)
    unit = float(seen.length.mean())
    affine = np.column_stack([b / unit, np.eye(data.centres)[data.centre]])
    response = (seen.unit * seen.inverse_std).T @ matrix
    # at the foot points: beside unknown constants a change of scale would otherwise be the residual itself
    foot = np.column_stack([(seen.unit * total_field).T / unit, affine[:, 3:]])
    inner = np.einsum("ni,nj->nij", response, foot).reshape(len(b), -1)
    levels = None if data.level is None else Levels(data.level, -seen.inverse_std)
    sighted = None
    if data.sighting is not None:
        side = across(data.sighting, slice(None), b, seen.length - total_field)
        turned = side.slope @ matrix
        rows = np.einsum("nki,nj->nkij", turned, affine).reshape(2 * len(b), -1)
        sighted = Sighted(side.residual.ravel(), rows, turned.reshape(-1, 3), data.sighting.coupling.ravel())
    left = (used.raw - fit.offset[data.centre]).reshape(len(b), -1) / fit.plane.noise
    return Residual(
        across=left - (left @ basis) @ basis.T if len(fit.plane.noise) > 3 else None,
        along=seen.residual,
        unit=unit,
        affine=affine,
        inner=inner if levels is None else levels.off(inner),
        basis=basis,
        reference_gain=-seen.inverse_std,
        noise=fit.plane.noise,
        samples=np.flatnonzero(fit.keep),
        slow_modes=SlowModes(response),
        sighted=sighted,
        levels=levels,
    )


def _beside_what_is_free(colours: Colours, residual: Residual, coefficients: int) -> Colours:
    """The colours of the noise, from those of a residual that so many coefficients and the fit's own freedom have made
    smaller."""
    samples, own = residual.affine.shape
    share = coefficients / residual.freedom  # of one of a sample's values
    across = replace(colours.across, white=colours.across.white * _more(samples, own + share))
    constants = 0 if residual.levels is None else int(residual.levels.number.max())
    more = _more(samples, 6 + 3 * (own - 3) + constants + share)
    rest = colours.along.rest if isinstance(colours.along, TurnedColour) else colours.along
    rest = replace(rest, white=rest.white * more)
    along = replace(colours.along, rest=rest) if isinstance(colours.along, TurnedColour) else rest
    return replace(colours, across=across, along=along)


def _more(samples: int, free: float) -> float:
    return samples / max(samples - free, 1.0)


def _terms(of: Together, samples: Samples, fit: SurveysFit, theta: Sequence[Array]) -> list[Terms]:
    """Those of each model, at the samples of all surveys, with the site's field as the coefficients have it so far."""
    views = [_excitation(of, samples, fit, k) for k in range(len(of.records))]
    if theta:
        views = [beside_the_site(x, models, theta) for x, models in zip(views, of.adopted, strict=True)]
    found = []
    for models in zip(*of.adopted, strict=True):
        try:
            found.append(stacked([model.terms(x) for model, x in zip(models, views, strict=True)]))
        except ValueError as error:
            raise DataError(f"the error model {models[0].name} cannot be fitted to these surveys: {error}") from error
    return found


def _excitation(of: Together, samples: Samples, fit: SurveysFit, survey: int) -> Excitation:
    """What error models see of one survey: outputs and field of the fit's common field."""
    turn = frame_of(fit.forward, fit.attitude_std is not None)
    forward = fit.forward @ turn
    factor = nominal(np.asarray(np.linalg.inv(forward), dtype=np.float64)).factor if of.nominal else 1.0
    offset = fit.offset[survey if len(fit.offset) > 1 else 0]
    raw = samples.raw[samples.survey == survey]
    y = ((raw - offset).reshape(len(raw), -1) / fit.plane.noise) @ fit.plane.basis
    b = y @ fit.found.matrix.T
    output = by_sensor(fit.forward, b) + offset
    common = np.repeat((factor * b @ turn)[:, None], len(forward), axis=1)
    return of.records[survey].excitation(output, common, matrix=forward / factor)


def _without(of: Together, each: Sequence[Terms], theta: Sequence[Array]) -> Samples:
    """Outputs and total field with the effects taken off."""
    samples = of.samples
    time = np.concatenate([record.time for record in of.records])
    runs = [record.run - record.run[0] for record in of.records]
    firsts = np.cumsum([0, *(run[-1] + 1 for run in runs)])
    run = np.concatenate([run + first for run, first in zip(runs, firsts[:-1], strict=True)])
    total_field = samples.total_field
    for terms, coefficients in zip(each, theta, strict=True):
        total_field = total_field - terms.on_reference(coefficients)
    return replace(samples, raw=cleared(samples.raw, time, run, each, theta), total_field=total_field)
