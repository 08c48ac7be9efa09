"""Adopted effects in a calibration file: written, read again, and taken off another survey."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from magtensor.calibration.types import Array, ArrayCalibration
from magtensor.errors import DataError, UsageError
from magtensor.loop.correction import corrected_raw, corrected_reference
from magtensor.loop.model import Adopted
from magtensor.loop.record import record_of
from magtensor.registry import Registry
from magtensor.survey.model import Survey, Variable


def effect_variables(
    adopted: Sequence[Adopted], theta: Sequence[Array], means: Mapping[str, Array]
) -> dict[str, Variable]:
    """The effects as a variable of the group `calibration`; nothing where there are none."""
    if not adopted:
        return {}
    texts = [
        json.dumps(
            {
                "error_model": a.name,
                "kind": a.component.effect,
                "settings": dict(a.settings),
                "sensors": list(a.sensors),
                "theta": np.asarray(t).tolist(),
            },
            default=float,
        )
        for a, t in zip(adopted, theta, strict=True)
    ]
    attributes = {"channel_means": json.dumps({k: np.asarray(v).tolist() for k, v in means.items()})}
    return {"calibration/effects": (("effect",), np.array(texts, dtype=np.str_), attributes)}


def stored_effects(calibration: Survey, registry: Registry) -> tuple[list[Adopted], list[Array], dict[str, Array]]:
    """Effects, coefficients and channel means of a calibration.

    Raises:
        UsageError: an error model of the calibration is not installed.
    """
    if "calibration/effects" not in calibration:
        return [], [], {}
    variable = calibration["calibration/effects"]
    adopted, theta = [], []
    for text in variable.values:
        facts: dict[str, Any] = json.loads(str(text))
        name = facts["error_model"]
        if ("error_model", "", name) not in registry.components:
            raise UsageError(f"the calibration needs the error model {name}: {registry.unknown('error_model', name)}")
        component = registry.find("error_model", name)
        adopted.append(Adopted(component, facts["settings"], tuple(facts["sensors"])))
        theta.append(np.asarray(facts["theta"], dtype=float))
    means = {k: np.asarray(v, dtype=float) for k, v in json.loads(variable.attrs["channel_means"]).items()}
    return adopted, theta, means


def cleaned(
    survey: Survey,
    calibration: ArrayCalibration,
    adopted: Sequence[Adopted],
    theta: Sequence[Array],
    means: Mapping[str, Array],
) -> Survey:
    """The survey with the adopted effects taken off `b_raw` and `total_field`.

    Raises:
        DataError: the survey lacks a channel that an effect follows.
    """
    if not adopted:
        return survey
    record = record_of(survey, means=means, every=True)
    try:
        raw = corrected_raw(record, calibration, adopted, theta, survey.good)
        field = corrected_reference(record, adopted, theta)
    except (KeyError, ValueError) as error:
        raise DataError(
            f"an effect of the calibration cannot be corrected on this survey: {error}",
            where=str(survey.attributes.get("source", "")),
            hint="the calibration follows a channel that this survey must log too",
        ) from error
    changed: dict[str, Variable] = {"b_raw": (("time", "sensor", "axis"), raw, dict(survey["b_raw"].attrs))}
    if field is not None:
        changed["total_field"] = (("time",), field, dict(survey["total_field"].attrs))
    return survey.merged(changed)
