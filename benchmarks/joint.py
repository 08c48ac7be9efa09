"""The joint fit's speed, memory and accuracy beside algebraic ellipsoid fits: `python benchmarks/joint.py`.

Prints the tables of docs/benchmarks/joint.md; `--plot FILE.svg` draws the growth with the number of samples. Each
figure is that of a process of its own on the same simulated sensors (50 000 nT, offsets of some 100 nT, 5 % of scale,
1 to 2 deg, 3 nT of noise, METHODS part C); peer and product take turns, so that what else the machine does meets
both. Peers need not be installed where the product is: `--peer-python PATH` names an interpreter that has them, and
`--nliaudat PATH` the script calibrate.py of github.com/nliaudat/magnetometer_calibration, which no package has; one
that cannot be imported is left out, with its reason.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

FIELD_NT, NOISE_NT = 50_000.0, 3.0
PEER = "magyc 1.0.0 ellipsoid_fit_fang"
SCRIPT = "nliaudat calibrate.py"
PEERS = (PEER, SCRIPT)
JOINT = "magtensor joint"
FROM_DISK = "magtensor joint, from disk"
TURNS, REPEATS = 3, 3
PIECE = 100_000


def true_sensors(sensors: int) -> tuple[np.ndarray, np.ndarray]:
    """C (S, 3, 3) and o (S, 3) nT."""
    rng = np.random.default_rng(1)
    small = np.radians(1.5) * rng.standard_normal((sensors, 3, 3))
    forward = np.eye(3) * (1 + 0.05 * rng.standard_normal((sensors, 1, 3))) + small
    return forward, 100.0 * rng.standard_normal((sensors, 3))


def piece(samples: int, sensors: int, seed: int) -> np.ndarray:
    """Raw outputs (N, S, 3) nT over the full sphere."""
    rng = np.random.default_rng(seed)
    field = rng.standard_normal((samples, 3))
    field *= FIELD_NT / np.linalg.norm(field, axis=1, keepdims=True)
    forward, offset = true_sensors(sensors)
    raw = np.einsum("sij,nj->nsi", forward, field) + offset
    raw += NOISE_NT * rng.standard_normal(raw.shape)
    return raw


def recorded(raw: Any, samples: int, sensors: int) -> Any:
    """`raw` (N, S, 3), an array or a dataset, filled piece by piece: making it takes no memory beside it."""
    for start in range(0, samples, PIECE):
        stop = min(start + PIECE, samples)
        raw[start:stop] = piece(stop - start, sensors, seed=10 + start)
    return raw


def error_nT(correction: np.ndarray, offset: np.ndarray, sensor: int, sensors: int) -> float:
    """Rms of |b| - F on 20 000 vectors without noise, one overall scale free (peers choose their own)."""
    rng = np.random.default_rng(3)
    field = rng.standard_normal((20_000, 3))
    field *= FIELD_NT / np.linalg.norm(field, axis=1, keepdims=True)
    forward, true_offset = true_sensors(sensors)
    length = np.linalg.norm((field @ forward[sensor].T + true_offset[sensor] - offset) @ correction.T, axis=1)
    return float(np.sqrt(np.mean((length * FIELD_NT / length.mean() - FIELD_NT) ** 2)))


def fang(samples: int, sensors: int) -> tuple[Callable[[], Any], Callable[[Any], float]]:
    """The peer fits each sensor alone."""
    from magyc import ellipsoid_fit_fang

    raw = list(recorded(np.empty((sensors, samples, 3)).swapaxes(0, 1), samples, sensors).swapaxes(0, 1))

    def fit() -> Any:
        return [ellipsoid_fit_fang(r)[:2] for r in raw]

    return fit, lambda found: max(error_nT(np.linalg.inv(m), o, s, sensors) for s, (o, m) in enumerate(found))


def nliaudat(samples: int, sensors: int) -> tuple[Callable[[], Any], Callable[[Any], float]]:
    """The peer fits each sensor alone; it is a script that prints."""
    import contextlib
    import importlib.util

    if "NLIAUDAT" not in os.environ:
        raise SystemExit("no script named with --nliaudat")
    spec = importlib.util.spec_from_file_location("calibrate", os.environ["NLIAUDAT"])
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    raw = list(recorded(np.empty((sensors, samples, 3)).swapaxes(0, 1), samples, sensors).swapaxes(0, 1))

    def fit() -> Any:
        found = []
        for each in raw:
            one = module.MagnetometerCalibrator(FIELD_NT)
            with contextlib.redirect_stdout(None):
                one.calibrate(each)
            found.append((one.b.ravel(), one.A_1))
        return found

    return fit, lambda found: max(error_nT(m, o, s, sensors) for s, (o, m) in enumerate(found))


def joint(samples: int, sensors: int) -> tuple[Callable[[], Any], Callable[[Any], float]]:
    """All sensors together, robust, with the covariance of all parameters."""
    from magtensor.calibration.joint import calibrated, fit_joint

    raw, total_field = recorded(np.empty((samples, sensors, 3)), samples, sensors), np.full(samples, FIELD_NT)

    def fit() -> Any:
        return calibrated(fit_joint(raw, total_field))

    return fit, _error(sensors)


def from_disk(samples: int, sensors: int) -> tuple[Callable[[], Any], Callable[[Any], float]]:
    """The same from an HDF5 file that is read in pieces."""
    import h5py

    from magtensor.calibration.joint import calibrated, fit_recording

    folder = tempfile.TemporaryDirectory()
    path = Path(folder.name) / "long.h5"
    with h5py.File(path, "w") as file:
        recorded(
            file.create_dataset("b_raw", (samples, sensors, 3), dtype="f8", chunks=(4096, sensors, 3)), samples, sensors
        )

    class Recording:
        usable, held = None, folder

        @property
        def count(self) -> int:
            return samples

        @property
        def sensors(self) -> int:
            return sensors

        def read(self, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
            return file["b_raw"][start:stop], np.full(stop - start, FIELD_NT)

    file = h5py.File(path)
    return lambda: calibrated(fit_recording(Recording())), _error(sensors)


def _error(sensors: int) -> Callable[[Any], float]:
    return lambda found: max(error_nT(found.matrix[s], found.offset[s], s, sensors) for s in range(sensors))


WAYS = {PEER: fang, SCRIPT: nliaudat, JOINT: joint, FROM_DISK: from_disk}


def worker(name: str, samples: int, sensors: int) -> None:
    """Fit a few times and print seconds of the fastest, peak memory and error as JSON."""
    fit, error = WAYS[name](samples, sensors)
    seconds = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        found = fit()
        seconds.append(time.perf_counter() - begin)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"seconds": min(seconds), "peak_MB": peak, "error_nT": error(found)}))


def measured(name: str, samples: int, sensors: int, python: str) -> dict[str, float] | str:
    """The worker's figures, or why there are none."""
    interpreter = python if name in PEERS else sys.executable
    command = [interpreter, __file__, "--worker", name, str(samples), str(sensors)]
    done = subprocess.run(command, env=os.environ | {"OPENBLAS_NUM_THREADS": "1"}, capture_output=True, text=True)
    if done.returncode:
        return (done.stderr.strip().splitlines() or ["no reason given"])[-1]
    figures: dict[str, float] = json.loads(done.stdout)
    return figures


def beside(samples: int, sensors: int, python: str) -> None:
    """Print rows of peer and product, taking turns."""
    best: dict[str, dict[str, float]] = {}
    reason: dict[str, str] = {}
    for _ in range(TURNS):
        for name in (*PEERS, JOINT):
            found = measured(name, samples, sensors, python)
            if isinstance(found, str):
                reason[name] = found
                if name == JOINT:
                    raise SystemExit(f"{name}: {found}")
            elif name not in best or found["seconds"] < best[name]["seconds"]:
                best[name] = found
    for name in (*PEERS, JOINT):
        if name not in best:
            print(f"| {sensors} | {name} | left out: {reason[name]} | | | |", flush=True)
            continue
        row = best[name]
        ratio = f"{row['seconds'] / best[PEER]['seconds']:.2f}" if PEER in best else ""
        print(
            f"| {sensors} | {name} | {row['seconds']:.3f} | {ratio} | {row['peak_MB']:.0f} | {row['error_nT']:.4f} |",
            flush=True,
        )


def plotted(rows: list[tuple[int, int, str, float]], path: Path) -> None:
    """Seconds over samples, both logarithmic."""
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot

    matplotlib.rcParams["svg.hashsalt"] = "joint"
    figure, axes = pyplot.subplots(figsize=(6, 4))
    for sensors, name in dict.fromkeys((s, n) for s, _, n, _ in rows):
        points = [(n, t) for s, n, k, t in rows if (s, k) == (sensors, name)]
        axes.loglog(*zip(*points, strict=True), marker="o", label=f"{name}, {sensors} sensor{'s' * (sensors > 1)}")
    axes.set_xlabel("samples")
    axes.set_ylabel("s")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peer-python", default=sys.executable, help="an interpreter that can import the peers")
    parser.add_argument("--nliaudat", type=Path, help="the script calibrate.py of that peer")
    parser.add_argument("--quick", action="store_true", help="at most 100 000 samples")
    parser.add_argument("--plot", type=Path, help="draw the second table")
    parser.add_argument("--worker", nargs=3, metavar=("NAME", "SAMPLES", "SENSORS"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.worker:
        worker(chosen.worker[0], int(chosen.worker[1]), int(chosen.worker[2]))
        return
    if chosen.nliaudat is not None:
        os.environ["NLIAUDAT"] = str(chosen.nliaudat.resolve())
    most = 100_000 if chosen.quick else 1_000_000
    print(f"{most} samples; a peer's fit of several sensors is the sum of its single fits\n")
    print("| sensors | fit | s | over magyc | peak MB | worst error nT |\n|---|---|---|---|---|---|")
    for sensors in (1, 4):
        beside(most, sensors, chosen.peer_python)
    print("\n| sensors | samples | fit | s | us a sample | peak MB | worst error nT |\n|---|---|---|---|---|---|---|")
    rows = []
    counts = (10_000, 100_000) if chosen.quick else (10_000, 100_000, 1_000_000, 10_000_000)
    for sensors in (1, 4):
        for samples in counts:
            for name in (JOINT, FROM_DISK):
                found = measured(name, samples, sensors, chosen.peer_python)
                if isinstance(found, str):
                    raise SystemExit(f"{name}: {found}")
                rows.append((sensors, samples, name, found["seconds"]))
                each = found["seconds"] / samples * 1e6
                print(
                    f"| {sensors} | {samples} | {name} | {found['seconds']:.3f} | {each:.2f} "
                    f"| {found['peak_MB']:.0f} | {found['error_nT']:.4f} |",
                    flush=True,
                )
    if chosen.plot:
        plotted(rows, chosen.plot)


if __name__ == "__main__":
    main()
