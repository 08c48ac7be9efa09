"""Which logged channel does the difference of two sensors follow? The measured recordings, by plain regression.

    python studies/measured.py balloon [--given CHANNEL ...]          (or quadcopter)

A check of the loop that shares nothing with it: one sensor's output is regressed on the other's three axes and a
constant, and on one channel more at a time; the error is that on ten contiguous blocks, each predicted from the other
nine. No noise model, no total field, no search over settings. Time and its square are there to be beaten. `--given`
puts channels into the model from the beginning; `turning` is the rate of change of the first sensor's three outputs,
which is what a delay between the two looks like.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from magtensor.loop.fitting.record import channels_of
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import read_plan
from magtensor.runner import run

RECIPES = Path(__file__).parents[1] / "recipes" / "measured"
BLOCKS = 10
SAMPLES = 12_000


def held_out(columns: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(3,) rms of the regression's error on contiguous blocks, each predicted from the others."""
    n = len(y)
    edges = np.linspace(0, n, BLOCKS + 1).round().astype(int)
    scale = np.sqrt(np.mean(columns**2, axis=0))
    z = columns / np.where(scale > 0, scale, 1.0)
    error = np.empty_like(y)
    for a, b in pairwise(edges):
        rest = np.r_[0:a, b:n]
        error[a:b] = y[a:b] - z[a:b] @ np.linalg.lstsq(z[rest], y[rest], rcond=1e-9)[0]
    return np.sqrt(np.mean(error**2, axis=0))


def recorded(name: str) -> tuple[list[str], np.ndarray, dict[str, np.ndarray]]:
    """Sensors' names, outputs (N, 2, 3) nT, and the regressors of each channel (N, K), as the recipe prepares them."""
    planned = read_plan(RECIPES / f"{name}.yaml")
    first = next(i for i, s in enumerate(planned.stages) if any("calibration/" in p for p in s.declares.gives))
    survey = run(replace(planned, stages=planned.stages[:first]), empty_survey(planned)).survey
    raw = survey.values("b_raw")
    turning = np.gradient(raw[:, 0], survey.time, axis=0)
    use = np.flatnonzero(survey.good & np.isfinite(raw).all(axis=(1, 2)))
    use = use[:: max(1, len(use) // SAMPLES)]
    found = {"turning": turning[use]}
    for key, values in {"time": survey.time, **channels_of(survey)[0]}.items():
        for i, column in enumerate(values[use].reshape(len(use), -1).T):
            if np.isfinite(column).all() and np.ptp(column) > 0:
                label = key if values.ndim == 1 else f"{key}[{i}]"
                found[label] = ((column - column.mean()) / column.std())[:, None]
    squares = {f"{k} and its square": np.hstack([v, v**2]) for k, v in found.items() if v.shape[1] == 1}
    return survey.sensors, raw[use], found | squares


def main(name: str, given: list[str]) -> None:
    sensors, raw, channels = recorded(name)
    base = np.column_stack([raw[:, 0], np.ones(len(raw)), *[channels[g] for g in given]])
    table = {"nothing more": held_out(base, raw[:, 1])}
    for label, columns in channels.items():
        if not any(label.startswith(g) for g in given):
            table[label] = held_out(np.column_stack([base, columns]), raw[:, 1])
    ranked = sorted(table, key=lambda k: float(np.sum(table[k] ** 2)))
    told = f"{sensors[0]}, {', '.join(given)}" if given else sensors[0]
    print(f"{sensors[1]} predicted from {told} and ... : error on blocks not fitted, nT rms (x, y, z, all)")
    for label in [*ranked[:12], *(k for k in ranked[12:] if k in ("nothing more", "time", "time and its square"))]:
        print(f"  {label:38s}" + "".join(f"{e:9.4g}" for e in (*table[label], np.sqrt(np.mean(table[label] ** 2)))))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", choices=("balloon", "quadcopter", "conrad"))
    parser.add_argument("--given", nargs="*", default=[])
    arguments = parser.parse_args()
    main(arguments.recording, arguments.given)
