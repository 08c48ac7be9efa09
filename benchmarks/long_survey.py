"""Surveys longer than the memory: seconds and peak memory of `run` and `apply`, whole and in windows.

`python benchmarks/long_survey.py [--samples N]` writes a canonical survey of four sensors at 250 Hz with a reference
at 1 Hz, runs load, detrend_diurnal, calibrate_joint, assemble_tensor and qc on it, and applies the calibration, each
in a process of its own. `--whole` also does both without windows.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from joint import PIECE, true_sensors

RATE_HZ, SENSORS = 250.0, 4
RECIPE = """title: a long survey
stages: [load, detrend_diurnal: {uncovered: mask}, calibrate_joint, assemble_tensor, qc]
"""


def written(path: Path, samples: int) -> None:
    """A tumbling array, written piece by piece."""
    forward, offset = true_sensors(SENSORS)
    epoch = "seconds since 2026-01-01T00:00:00Z"
    with h5py.File(path, "w") as file:
        clock = file.create_dataset("time", (samples,), dtype="f8")
        raw = file.create_dataset("b_raw", (samples, SENSORS, 3), dtype="f8", chunks=(4096, SENSORS, 3))
        seconds = np.arange(0.0, samples / RATE_HZ + 1.0)
        file["position"] = 0.25 * np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
        file["reference/time"], file["reference/total_field"] = seconds, total_field(seconds)
        for name, units in (
            ("time", epoch), ("b_raw", "nT"), ("position", "m"), ("reference/time", epoch),
            ("reference/total_field", "nT"),
        ):  # fmt: skip
            file[name].attrs["units"] = units
        for start in range(0, samples, PIECE):
            stop = min(start + PIECE, samples)
            at = np.arange(start, stop) / RATE_HZ
            roll, pitch = 0.7 * at + np.sin(0.11 * at), 0.31 * at + np.cos(0.07 * at)
            unit = np.column_stack([np.cos(roll) * np.cos(pitch), np.sin(roll) * np.cos(pitch), np.sin(pitch)])
            noise = np.random.default_rng(start).normal(0.0, 0.1, (stop - start, SENSORS, 3))
            clock[start:stop] = at
            raw[start:stop] = np.einsum("sij,nj->nsi", forward, unit * total_field(at)[:, None]) + offset + noise


def total_field(at: np.ndarray) -> np.ndarray:
    """nT."""
    field: np.ndarray = 50_000.0 + 20.0 * np.sin(at / 5_000.0)
    return field


def measured(*arguments: str) -> tuple[float, float, str]:
    """Seconds, peak MB and last line of a magtensor command, in a process that starts it and nothing else."""
    child = (
        "import resource, subprocess, sys; done = subprocess.run(sys.argv[1:]); "
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024); sys.exit(done.returncode)"
    )
    begin = time.perf_counter()
    command = [sys.executable, "-c", child, sys.executable, "-m", "magtensor", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OPENBLAS_NUM_THREADS": "1"})
    if done.returncode:
        raise SystemExit(done.stderr)
    *lines, peak = done.stdout.splitlines()
    return time.perf_counter() - begin, float(peak), lines[-1]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--memory", type=float, nargs="*", default=[0.6, 1.0], help="GiB")
    parser.add_argument("--whole", action="store_true")
    chosen = parser.parse_args()
    budgets: list[float | None] = [*chosen.memory, *([None] if chosen.whole else [])]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recipe, survey = folder / "recipe.yaml", folder / "survey.h5"
        recipe.write_text(RECIPE)
        written(survey, chosen.samples)
        print(f"{chosen.samples} samples of {SENSORS} sensors, a file of {survey.stat().st_size / 2**20:.0f} MB\n")
        print("| command | memory asked for | s | peak MB | result MB |\n|---|---|---|---|---|")
        for budget in budgets:
            asked = [] if budget is None else ["--memory", f"{budget}"]
            words = "the whole at once" if budget is None else f"{budget:g} GiB"
            out, applied = folder / "out", folder / "applied.nc"
            told = ""
            for command, file in (
                (["run", str(recipe), "--input", str(survey), "--output", str(out), *asked], out / "result.nc"),
                (["apply", str(out / "calibration.nc"), str(survey), "--output", str(applied), *asked], applied),
            ):
                seconds, peak, said = measured(*command)
                told = told or said
                size = file.stat().st_size / 2**20
                print(f"| {command[0]} | {words} | {seconds:.0f} | {peak:.0f} | {size:.0f} |", flush=True)
            print(f"\n{told}\n" if budget == budgets[-1] else "", end="")


if __name__ == "__main__":
    main()
