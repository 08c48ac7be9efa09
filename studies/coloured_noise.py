"""Whether the standard deviations of `calibrate_joint` hold in noise that is not white.

`python studies/coloured_noise.py` simulates recipes/scenarios/demo.yaml anew with each seed and prints the rms of
error / standard deviation over seeds, sensors and axes, 1 where the standard deviations are right: of the offsets, of
the elements of the matrices, and of the five differences of the tensor that the calibration's own errors make of a
uniform field; and how much wider than in white noise the standard deviations of the offsets are. The second table is
of surveys fitted together, of a total field that nobody measured, and of an attitude.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from magtensor.calibration.common_scale import nominal_scale
from magtensor.calibration.joint import calibrated, fit_recording, nearest_frame
from magtensor.calibration.recording import InMemory
from magtensor.calibration.surveys.changing import fit_changing
from magtensor.calibration.surveys.corrections import calibrated_surveys
from magtensor.calibration.surveys.dated import dated
from magtensor.calibration.surveys.fit import fit_surveys
from magtensor.calibration.surveys.samples import Samples, joined
from magtensor.calibration.surveys.straight import straight
from magtensor.calibration.types import ArrayCalibration
from magtensor.simulate.run import Simulated, simulate

DEMO = Path(__file__).resolve().parent.parent / "recipes/scenarios/demo.yaml"
CASES = (
    ("true", 0.0),
    ("true", 0.01),
    ("true", 0.05),
    ("base station", 0.0),
    ("base station", 0.01),
    ("taken as constant", 0.01),
)
# what is fitted, how many surveys together, flicker in nT/rtHz, total field
TOGETHER = (
    ("one C, own offsets", 3, 0.01, "true"),
    ("one C, own offsets", 3, 0.01, "base station"),
    ("C linear in the date, own offsets", 3, 0.01, "true"),
    ("total_field: per_survey", 2, 0.01, "unknown"),
    ("total_field: per_segment, of 100 s", 1, 0.01, "unknown"),
    ("vector_reference, attitude to 0.2 deg", 1, 0.01, "true"),
)
DIFFERENCES = ((0, 2, 0), (0, 2, 1), (0, 2, 2), (1, 3, 1), (1, 3, 2))  # sensors and axis: Chi 2017 eq. 2
ATTITUDES, FIELD_NT = 12, 49_500.0


def scenario_of(seed: int, flicker: float) -> dict[str, Any]:
    """The demo's, with everything but the instrument's own errors drawn anew."""
    scenario: dict[str, Any] = yaml.safe_load(DEMO.read_text()) | {"seed": seed}
    scenario["instrument"]["noise"]["flicker_nT_per_rtHz"] = flicker
    return scenario


def total_field_of(survey: Simulated, source: str) -> np.ndarray:
    """(N,) nT, as it is known to the fit."""
    assert survey.reference is not None
    size: np.ndarray = survey.truth.total_field
    if source == "base station":
        return np.interp(survey.time, survey.reference.time, survey.reference.total_field)
    return np.full(len(size), float(np.median(size))) if source in ("taken as constant", "unknown") else size


def alone(survey: Simulated, source: str) -> tuple[ArrayCalibration, np.ndarray]:
    """A survey's calibration, and C (S, 3, 3) as it is in its frame."""
    size = total_field_of(survey, source)
    found = calibrated(fit_recording(InMemory(survey.b_raw, size, np.ones(len(size), dtype=bool))))
    return found, survey.truth.matrix @ nearest_frame(survey.truth.matrix)


def together(surveys: list[Simulated], what: str, source: str) -> tuple[ArrayCalibration, np.ndarray]:
    """The calibration of the first of several surveys, and C (S, 3, 3) as it is in its frame."""
    forward, vector = surveys[0].truth.matrix, what.startswith("vector")
    parts = []
    for number, survey in enumerate(surveys):
        count = len(survey.time)
        level = None if source != "unknown" else np.zeros(count, dtype=int)
        if "segment" in what:
            level = (survey.time // 100.0).astype(int)
        direction = _attitude(survey, number) if vector else None
        none = np.zeros(count, dtype=int)
        size = np.full(count, 50_000.0) if source == "unknown" else total_field_of(survey, source)
        parts.append(Samples(survey.b_raw, size, none, none, level, direction))
    if what.startswith("C linear"):
        fit = fit_changing(joined(parts), np.arange(len(surveys), dtype=float))
        found = dated(fit, straight(fit), 0).calibration
    else:
        found = calibrated_surveys(fit_surveys(joined(parts))).of_survey(0)
    in_frame = forward if vector else forward @ nearest_frame(forward)
    if source == "unknown":
        found, _, _ = nominal_scale(found)
        in_frame = in_frame * np.exp(-np.mean(np.linalg.slogdet(in_frame)[1]) / 3.0)
    return found, in_frame


def _attitude(survey: Simulated, number: int) -> np.ndarray:
    """(N, 3) unit vectors: the field's direction by an attitude that errs by 0.2 deg about every axis."""
    unit = survey.truth.b.mean(axis=1)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    small = np.radians(0.2) * np.random.default_rng([survey.scenario.seed, number]).standard_normal(unit.shape)
    turned = unit + np.cross(small, unit)
    out: np.ndarray = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return out


def ratios(
    found: ArrayCalibration, forward: np.ndarray, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Errors of the offsets, of the matrices and of the differences over their standard deviations; the widening."""
    sensors = len(forward)
    errors = np.concatenate(
        [(found.matrix - np.linalg.inv(forward)).reshape(sensors, 9), found.offset - offset], axis=1
    )
    standard = (errors.ravel() / np.sqrt(np.diag(found.covariance))).reshape(sensors, 12)
    along = np.random.default_rng(0).standard_normal((ATTITUDES, 3))
    along *= FIELD_NT / np.linalg.norm(along, axis=1, keepdims=True)
    tensor = []
    for b in along:
        rows = np.zeros((len(DIFFERENCES), sensors, 12))
        for row, (first, second, axis) in zip(rows, DIFFERENCES, strict=True):
            for sign, sensor in ((1.0, first), (-1.0, second)):
                row[sensor, 3 * axis : 3 * axis + 3] = sign * forward[sensor] @ b
                row[sensor, 9:] = -sign * found.matrix[sensor, axis]
        flat = rows.reshape(len(DIFFERENCES), -1)
        tensor.append(flat @ errors.ravel() / np.sqrt(np.einsum("ki,ij,kj->k", flat, found.covariance, flat)))
    return standard[:, 9:], standard[:, :9], np.array(tensor), float(found.diagnostics.get("widened_offsets", 1.0))


def row(words: str, errors: list[tuple[np.ndarray, np.ndarray, np.ndarray, float]]) -> None:
    """Print one row: the rms of every kind, and the mean widening."""
    *kinds, widened = zip(*errors, strict=True)
    rms = " | ".join(f"{np.sqrt(np.mean(np.square(kind))):.2f}" for kind in kinds)
    print(f"| {words} | {rms} | {np.mean(widened):.1f} |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=24)
    parser.add_argument("--table", choices=("alone", "together"), help="one of them alone")
    chosen = parser.parse_args()
    seeds = chosen.seeds
    if chosen.table != "together":
        print(f"| total field | flicker, nT/rtHz | offsets | matrices | tensor | widened, {seeds} surveys |")
        print("|---|---|---|---|---|---|")
        for source, flicker in CASES:
            errors = []
            for seed in range(4001, 4001 + seeds):
                survey = simulate(scenario_of(seed, flicker))
                errors.append(ratios(*alone(survey, source), survey.truth.offset))
            row(f"{source} | {flicker:g}", errors)
    if chosen.table != "alone":
        print(f"| fitted | surveys | total field | offsets | matrices | tensor | widened, {seeds} fits |")
        print("|---|---|---|---|---|---|---|")
        for what, count, flicker, source in TOGETHER:
            errors = []
            for seed in range(seeds):
                surveys = [simulate(scenario_of(5001 + count * seed + k, flicker)) for k in range(count)]
                errors.append(ratios(*together(surveys, what, source), surveys[0].truth.offset))
            row(f"{what} | {count} | {source}", errors)


if __name__ == "__main__":
    main()
