"""The stage that brings the scalar reference to the array's times and takes the field's variation apart."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from magtensor.between_readings import Course, followed_best
from magtensor.components import stage
from magtensor.errors import DataError
from magtensor.survey import reference
from magtensor.survey.flags import Flag, flag_ranges
from magtensor.survey.model import Survey

BY = "detrend_diurnal"
USUAL_GAP = 5.0  # median steps of the reference: four samples in a row lost


@stage(
    needs=("reference/time", "reference/total_field"),
    gives=("total_field", "diurnal"),
    may_give=("total_field_std", "good"),
)
def detrend_diurnal(
    survey: Survey,
    *,
    interpolation: Annotated[
        Literal["auto"] | Course,
        Field(
            description="between two readings: monotone cubic or straight lines, which never overshoot, a cubic "
            "spline, or auto: the spline where it predicts readings left out better than the monotone cubic"
        ),
    ] = "auto",
    latency_s: Annotated[
        float, Field(description="the reference's stamps are late by this: stamped t, measured at t - latency_s")
    ] = 0.0,
    max_gap_s: Annotated[
        float | None, Field(gt=0, description="longest step of the reference to cross, s; default: 5 median steps")
    ] = None,
    uncovered: Annotated[
        Literal["refuse", "mask"],
        Field(description="samples in gaps of the reference or beyond its ends: refuse the survey, or flag them"),
    ] = "refuse",
    base: Annotated[
        float | Literal["mean", "median", "first"],
        Field(description="what the variation is counted from: a statistic over the survey, or a value in nT"),
    ] = "mean",
    despike: Annotated[
        float | None,
        Field(gt=0, description="leave out reference samples this many robust standard deviations off; default: none"),
    ] = None,
) -> dict[str, Any]:
    """The total field at each sample, and how far it differs from its base value (the diurnal variation).

    `total_field` is the reference at the array's times; `diurnal` is `total_field` minus the base value, that is,
    what a scalar survey subtracts. A scalar cannot be subtracted from a vector sensor: b_raw stays as it is, and
    the calibration compares each sample's magnitude with its own `total_field`. `total_field_std` is given for a
    measured reference: its noise and resolution, carried through the interpolation.
    """
    record = survey["reference/total_field"]
    where = f"{survey.attributes.get('source', '')}: reference/total_field"
    time, at = np.asarray(survey.values("reference/time"), dtype=np.float64), survey.time
    values = np.asarray(record.values, dtype=np.float64)
    known = np.isfinite(values) & np.isfinite(time)
    time, values = time[known] - latency_s, values[known]
    if len(values) == 0:
        raise DataError("every value is missing", where=where)
    if not (np.diff(time) > 0).all():
        raise DataError("its times do not increase", where=where, hint="the stage `load` can drop such samples")
    flags: list[Flag] = []
    if despike is not None and len(values) > reference.SPIKE_WINDOW:
        bad = reference.spikes(values, despike, time)
        flags += flag_ranges(time, bad, by=BY, reason="spike in the reference", sensor="reference")
        time, values = time[~bad], values[~bad]
    origin = str(record.attrs.get("origin", "measured"))
    constant = origin == "constant"
    how: Course = "linear"
    if constant:
        found = reference.Sampled(np.full(len(at), values[0]), np.ones(len(at), bool), np.ones(len(at)))
    else:
        gap = (
            max_gap_s
            if max_gap_s is not None
            else USUAL_GAP * float(np.median(np.diff(time)))
            if len(time) > 1
            else 1.0
        )
        how = followed_best(time, values) if interpolation == "auto" else interpolation
        found = reference.sample(at, time, values, how=how, max_gap_s=gap)
        if not found.covered.all():
            _refuse_or_tell(at, found.covered, time, gap, uncovered, where)
    field = found.values
    if isinstance(base, str):
        covered = field[found.covered]
        value = float({"mean": covered.mean(), "median": np.median(covered), "first": covered[0]}[base])
    else:
        value = float(base)
    facts = {"units": "nT", "origin": origin}
    made: dict[str, Any] = {"interpolation": how, "latency_s": latency_s, "base_nT": value}
    if despike is not None:
        made["despike"] = despike
    variables: dict[str, Any] = {
        "total_field": (("time",), field, {**facts, **made}),
        "diurnal": (("time",), field - value, {**facts, "base_nT": value, "long_name": "variation of the total field"}),
    }
    if origin == "measured":
        std = reference.noise(values) * found.weight_norm
        variables["total_field_std"] = (("time",), np.where(found.covered, std, np.nan), {"units": "nT"})
    if not found.covered.all():
        flags += flag_ranges(at, ~found.covered, by=BY, reason="the reference does not cover this time")
        good = survey.good_by_sensor & found.covered[:, None]
        variables["good"] = (("time", "sensor"), good, {"long_name": "may be used"})
    return {**variables, "flags": flags}


def _refuse_or_tell(at: Any, covered: Any, time: Any, gap: float, uncovered: str, where: str) -> None:
    """Refuse a survey that the reference does not cover, unless only a part of it is to be masked."""
    span = (
        f"the reference lasts from t = {time[0]:.3f} to {time[-1]:.3f} s, the survey from {at[0]:.3f} to {at[-1]:.3f} s"
    )
    if not covered.any():
        raise DataError(
            f"the reference covers no sample of the survey: {span}",
            where=where,
            hint="are both clocks in UTC, and their epochs right?",
        )
    if uncovered == "refuse":
        first = float(at[~covered][0])
        raise DataError(
            f"the reference does not cover {int((~covered).sum())} of {len(at)} samples, first at t = {first:.3f} s",
            where=where,
            hint=f"{span}; steps over {gap:g} s are gaps (max_gap_s); `uncovered: mask` flags these samples instead",
        )
