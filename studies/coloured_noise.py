"""Whether the standard deviations of `calibrate_joint` hold in noise that is not white.

`python studies/coloured_noise.py` simulates recipes/scenarios/demo.yaml anew with each seed and prints the rms of
error / standard deviation over seeds, sensors and axes, 1 where the standard deviations are right: of the offsets, of
the elements of the matrices, and of the five differences of the tensor that the calibration's own errors make of a
uniform field; and how much wider than in white noise the standard deviations of the offsets are.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from magtensor.calibration.joint import calibrated, fit_recording, nearest_frame
from magtensor.calibration.recording import InMemory
from magtensor.simulate.run import simulate

DEMO = Path(__file__).resolve().parent.parent / "recipes/scenarios/demo.yaml"
CASES = (
    ("true", 0.0),
    ("true", 0.01),
    ("true", 0.05),
    ("base station", 0.0),
    ("base station", 0.01),
    ("taken as constant", 0.01),
)
DIFFERENCES = ((0, 2, 0), (0, 2, 1), (0, 2, 2), (1, 3, 1), (1, 3, 2))  # sensors and axis: Chi 2017 eq. 2
ATTITUDES = 12


def ratios(scenario: dict[str, Any], source: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Errors of the offsets, of the matrices and of the differences over their standard deviations; the widening."""
    survey = simulate(scenario)
    assert survey.reference is not None
    size = survey.truth.total_field
    if source == "base station":
        size = np.interp(survey.time, survey.reference.time, survey.reference.total_field)
    elif source == "taken as constant":
        size = np.full(len(size), float(np.median(size)))
    found = calibrated(fit_recording(InMemory(survey.b_raw, size, np.ones(len(size), dtype=bool))))
    forward = survey.truth.matrix @ nearest_frame(survey.truth.matrix)
    sensors = len(forward)
    errors = np.concatenate(
        [(found.matrix - np.linalg.inv(forward)).reshape(sensors, 9), found.offset - survey.truth.offset], axis=1
    )
    standard = (errors.ravel() / np.sqrt(np.diag(found.covariance))).reshape(sensors, 12)
    along = np.random.default_rng(0).standard_normal((ATTITUDES, 3))
    along *= np.median(size) / np.linalg.norm(along, axis=1, keepdims=True)
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=24)
    seeds = parser.parse_args().seeds
    print(f"| total field | flicker, nT/rtHz | offsets | matrices | tensor | widened, {seeds} surveys |")
    print("|---|---|---|---|---|---|")
    for source, flicker in CASES:
        errors = []
        for seed in range(4001, 4001 + seeds):
            scenario = yaml.safe_load(DEMO.read_text()) | {"seed": seed}
            scenario["instrument"]["noise"]["flicker_nT_per_rtHz"] = flicker
            errors.append(ratios(scenario, source))
        *kinds, widened = zip(*errors, strict=True)
        rms = " | ".join(f"{np.sqrt(np.mean(np.square(kind))):.2f}" for kind in kinds)
        print(f"| {source} | {flicker:g} | {rms} | {np.mean(widened):.1f} |", flush=True)


if __name__ == "__main__":
    main()
