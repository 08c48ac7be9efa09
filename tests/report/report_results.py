"""Results made in memory, without a recipe: what a finished run would have left behind."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from magtensor import result
from magtensor.calibrated import contrasts, corrected, stored
from magtensor.calibration.noise import noise_std
from magtensor.calibration.types import ArrayCalibration
from magtensor.provenance import Provenance
from magtensor.survey.flags import flag_ranges
from magtensor.survey.model import AXES, Survey
from magtensor.tensor.assembly import least_squares_assembly
from magtensor.tensors import assembled, assembly_variables
from magtensor.verdict import verdict

CROSS = np.array([[0.25, 0, 0], [0, 0.25, 0], [-0.25, 0, 0], [0, -0.25, 0]])
NOISE = 0.15  # nT


def provenance(**changes: Any) -> Provenance:
    made_by = Provenance(
        recipe={
            "title": "Cross of four fluxgates, tumbled at the calibration site",
            "description": "Half an hour by hand, beside a proton magnetometer.",
            "authors": ["A. Surveyor", "B. Physicist"],
            "references": ["Chi, Ren and Liu 2017, Sensors 17, 2122, https://doi.org/10.3390/example"],
            "stages": [{"load": {}}, {"calibrate_scalar": {"method": "chi2017"}}],
        },
        inputs=[{"path": "/data/survey.nc", "sha256": "ab" * 32, "bytes": 123456}],
        versions={"magtensor": "0.1.0", "numpy": "2.1.0"},
        plugins=[{"name": "magtensor", "version": "0.1.0"}],
        stages=[
            {"name": "load", "options": {}, "started": "2026-03-21T10:00:00", "duration_s": 0.12, "read": [],
             "wrote": ["b_raw", "time"]},
            {"name": "calibrate_scalar", "options": {"method": {"chi2017": {}}}, "started": "2026-03-21T10:00:01",
             "duration_s": 1.5, "read": ["b_raw"], "wrote": ["calibration/matrix"]},
        ],
    )  # fmt: skip
    return dataclasses.replace(made_by, **changes)


def tumbling(samples: int, rng: np.random.Generator) -> np.ndarray:
    """Unit directions (N, 3) of a slow random tumbling."""
    t = np.arange(samples) * 0.1
    phases = rng.uniform(0, 2 * np.pi, (3, 4))
    rates = rng.uniform(0.05, 0.4, (3, 4))
    v = np.stack([np.sin(rates[k][:, None] * t + phases[k][:, None]).sum(axis=0) for k in range(3)], axis=1)
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def calibrated_survey(
    samples: int = 900, sensors: tuple[str, ...] = ("S1", "S2", "S3", "S4"), *, seed: int = 7, effect_nT: float = 0.0
) -> Survey:
    """A survey as it is after the last stage: true fields with noise, known responses, a total field, QC, flags.

    With fewer than three sensors it has no tensor. `effect_nT` adds a slow wave to the first sensor's x output.
    """
    rng = np.random.default_rng(seed)
    count = len(sensors)
    time = 1000.0 + np.arange(samples) * 0.1
    diurnal = 8.0 * np.sin(2 * np.pi * time / 5000.0)
    total_field = 49500.0 + diurnal
    b = (tumbling(samples, rng) * total_field[:, None])[:, None, :] + NOISE * rng.standard_normal((samples, count, 3))
    b[:, 0, 0] += effect_nT * np.sin(2 * np.pi * time / 60.0)
    matrix = np.eye(3) + 0.01 * rng.standard_normal((count, 3, 3))
    offset = 60.0 * rng.standard_normal((count, 3))
    raw = np.einsum("sij,nsj->nsi", np.linalg.inv(matrix), b) + offset
    scale = np.tile(np.r_[np.full(9, 2e-6), np.full(3, 0.05)], count)
    calibration = ArrayCalibration(
        matrix, offset, np.diag(scale**2), f"sensor {sensors[0]}", ("a rotation of the whole array",),
        {"condition_number": 3.21},
    )  # fmt: skip
    good = np.ones((samples, count), dtype=bool)
    good[samples // 3 : samples // 3 + samples // 50, 0] = False
    survey = Survey.build(
        {
            "time": (("time",), time, {"units": "seconds since 2026-03-21T09:00:00Z"}),
            "sensor": (("sensor",), np.array(sensors), {}),
            "axis": (("axis",), np.array(AXES), {}),
            "b_raw": (("time", "sensor", "axis"), raw, {"units": "nT"}),
            "total_field": (("time",), total_field, {"units": "nT"}),
            "diurnal": (("time",), diurnal, {"units": "nT"}),
            "good": (("time", "sensor"), good, {}),
        },
        {"title": "Test site, March", "instrument": "four fluxgates"},
    )
    flags = flag_ranges(time, ~good[:, 0], by="load", reason="output at the end of its range", sensor=sensors[0])
    survey = survey.merged({}, flags)
    survey = survey.merged(stored(calibration, list(sensors), method="chi2017") | corrected(calibration, survey))
    survey = survey.merged(parameters(count, rng))
    if count > 1:
        survey = survey.merged(contrasts(survey.values("calibrated/b")))
    if count > 2:
        position = np.resize(CROSS, (count, 3)) + np.repeat(np.arange(-(-count // 4)), 4)[:count, None] * [0, 0, 0.3]
        noise = noise_std(survey.values("calibrated/b"), total_field)
        assembly = least_squares_assembly(position)
        survey = survey.merged(
            assembly_variables(assembly, position, noise)
            | assembled(assembly, survey.values("calibrated/b"), position, noise, calibration)
        )
    return survey.merged(quality())


def parameters(count: int, rng: np.random.Generator) -> dict[str, Any]:
    """Chi's parameters as a variable over (sensor, chi_parameter), with deviations."""
    names = ("phi", "theta", "psi", "k_x")
    units = {"phi": "rad", "theta": "rad", "psi": "rad", "k_x": "1"}
    values = rng.normal(0.0, 0.01, (count, 4)) + np.array([0, 0, 0, 1])
    return {
        "calibration/chi_parameter": (("chi_parameter",), np.array(names), {"units_of_each": json.dumps(units)}),
        "calibration/chi": (("sensor", "chi_parameter"), values, {"long_name": "parameters of Chi 2017"}),
        "calibration/chi_std": (("sensor", "chi_parameter"), np.full((count, 4), 1.2e-5), {}),
    }


def quality() -> dict[str, Any]:
    """A verdict of each state."""
    return {
        "qc/metric": (("metric",), np.array(["total_field_rms S1", "flagged S1", "spread S2"]), {"worst": "fail"}),
        "qc/value": (("metric",), np.array([0.16, np.nan, 1234.5]), {}),
        "qc/limit": (("metric",), np.array([0.23, 0.01, np.nan]), {}),
        "qc/state": (("metric",), np.array(["pass", "warn", "fail"]), {}),
        "qc/words": (("metric",), np.array(["like noise", "no samples", "much too wide"]), {}),
        "qc/units": (("metric",), np.array(["nT", "1", "nT2/m2"]), {}),
    }


def save(folder: Path, survey: Survey, outcome: dict[str, Any] | None = None, **changes: Any) -> Path:
    """The files of a finished run without the page; `changes` are to the provenance."""
    folder.mkdir(exist_ok=True)
    result.save(result.result_tree(survey), provenance(**changes), folder / result.RESULT)
    (folder / result.VERDICT).write_text(json.dumps(outcome or verdict(survey)))
    return folder
