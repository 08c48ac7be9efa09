"""An inquiry where the attitudes determine no calibration: with sensors taken near nominal, and saying so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from magtensor.calibration.known import Known
from magtensor.calibration.nominal import Nominal
from magtensor.calibration.types import ArrayCalibration
from magtensor.calibration.undetermined import Undetermined, undetermined
from magtensor.errors import DataError, NotEnoughData
from magtensor.loop.fitting.model import Fitting
from magtensor.loop.fitting.refit import require_determined
from magtensor.loop.fitting.refit import settled as fitted_in_the_end
from magtensor.loop.inquiry import Inquiry
from magtensor.loop.searching.found import Search

Inquire = Callable[[Fitting], Inquiry]


def settled(inquire: Inquire, how: Fitting, nominal: Nominal | None) -> tuple[Inquiry, Search, str]:
    """An inquiry that ends with a determined calibration, or else one with a prior; and what it found.

    Parameters
    ----------
    inquire: makes an inquiry, with its decisions, for a way of fitting.
    nominal: the prior; None refuses a survey that needs it.

    Returns
    -------
    Beside the two, why the fit without a prior was refused; "" where it was not, or the end needs none.

    Raises
    ------
    DataError: there is no calibration, and a prior is not wanted or does not help.
    """

    def ended(how: Fitting) -> tuple[Inquiry, Search]:
        inquiry = inquire(how)
        found = inquiry.found()
        require_determined(found.record, found.last, how)
        return inquiry, found

    try:
        return *ended(how), ""
    except DataError as error:  # of too few attitudes, or of what these make of a strong effect
        refusal = error
    if nominal is None or how.nominal is not None:
        raise refusal
    try:
        inquiry, found = ended(replace(how, nominal=nominal))
    except DataError as error:
        raise _refused(refusal, error) from error
    free = _by_itself(found)
    return (inquiry, found, refusal.what) if free is None else (inquiry, free, "")


def _by_itself(found: Search) -> Search | None:
    """The search with the calibration that its samples and effects determine without the prior, which only what had no
    name before, or samples that are flagged now, made necessary; None where they determine none."""
    how = replace(found.how, nominal=None)
    try:
        require_determined(found.record, found.last, how)
        return replace(found, last=fitted_in_the_end(found.record, found.last, how), how=how)
    except DataError:
        return None


def begun(inquire: Inquire, how: Fitting, nominal: Nominal | None) -> Inquiry:
    """An inquiry whose first fit can be made, with a prior if need be.

    Parameters, raises: as `settled`.
    """
    inquiry = inquire(how)
    try:
        assert inquiry.first is not None
        return inquiry
    except DataError as error:
        refusal = error
    if nominal is None:
        raise refusal
    inquiry = inquire(replace(how, nominal=nominal))
    try:
        assert inquiry.first is not None
        return inquiry
    except DataError as error:
        raise _refused(refusal, error) from error


def _refused(first: DataError, second: DataError) -> DataError:
    if second.what == first.what:  # what no prior helps against
        return second
    if not isinstance(first, NotEnoughData):  # it was not for the attitudes
        return first
    also = f"with sensors taken near nominal: {second.what}"
    hint = "; ".join(p for p in (first.hint, also, second.hint) if p)
    return type(first)(first.what, where=first.where or second.where, hint=hint)


def doubt_of(found: Search, how: Fitting, known: Known, why: str) -> Undetermined | None:
    """What a calibration leaves open; None where its attitudes determine it."""
    if how.nominal is None:
        return None
    return undetermined(found.last.fit, how.nominal, found.record.sensors, known, why)


def labelled(calibration: ArrayCalibration, doubt: Undetermined) -> ArrayCalibration:
    """The calibration, saying of itself what is left open."""
    facts: dict[str, float | str] = {} if doubt.determined else {"undetermined": doubt.sentence}
    facts["worst_error_nT"] = doubt.total_field.worst
    return replace(
        calibration,
        unobservable=(*calibration.unobservable, *doubt.words),
        diagnostics={**calibration.diagnostics, **facts},
    )
