"""How far the offsets' standard deviations of `calibrate_joint`, which takes noise for white, can be believed.

`python studies/coloured_noise.py` simulates recipes/scenarios/demo.yaml anew with each seed and prints the rms of
(offset found - true) / standard deviation over seeds, sensors and axes; 1 where the standard deviations are right.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from magtensor.calibration.joint import calibrated, fit_recording
from magtensor.calibration.recording import InMemory
from magtensor.simulate.run import simulate

DEMO = Path(__file__).resolve().parent.parent / "recipes/scenarios/demo.yaml"


CASES = (("true", 0.0), ("base station", 0.0), ("base station", 0.01), ("taken as constant", 0.01))


def ratios(scenario: dict[str, Any], source: str) -> np.ndarray:
    """(S, 3) errors of the offsets over their standard deviations."""
    survey = simulate(scenario)
    assert survey.reference is not None
    size = survey.truth.total_field
    if source == "base station":
        size = np.interp(survey.time, survey.reference.time, survey.reference.total_field)
    elif source == "taken as constant":
        size = np.full(len(size), float(np.median(size)))
    found = calibrated(fit_recording(InMemory(survey.b_raw, size, np.ones(len(size), dtype=bool))))
    std = np.sqrt(np.diag(found.covariance).reshape(len(found.offset), 12)[:, 9:])
    return np.asarray((found.offset - survey.truth.offset) / std)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=8)
    seeds = parser.parse_args().seeds
    print(f"| total field | flicker, nT/rtHz | rms error / std, {seeds} surveys |\n|---|---|---|")
    for source, flicker in CASES:
        errors = []
        for seed in range(1001, 1001 + seeds):
            scenario = yaml.safe_load(DEMO.read_text()) | {"seed": seed}
            scenario["instrument"]["noise"]["flicker_nT_per_rtHz"] = flicker
            errors.append(ratios(scenario, source))
        print(f"| {source} | {flicker:g} | {np.sqrt(np.mean(np.square(errors))):.1f} |", flush=True)


if __name__ == "__main__":
    main()
