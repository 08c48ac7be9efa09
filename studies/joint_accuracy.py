"""The joint fit against the bound that noise sets, beside the published methods on the same data.

`python studies/joint_accuracy.py` prints the tables of docs/joint_accuracy.md. Arrays and surveys are those of METHODS
A4.8 (tests/joint/joint_cases.py, without the product's simulator): four sensors, 1 % of scale, 0.5 deg of
non-orthogonality, 2 deg of misalignment, 0.5 m of baseline, 1 nT of noise. Figures are medians over surveys of the
tensor error, nT/m rms over the five differences of Chi (2), that the calibration's own errors make in a uniform field
of fresh attitudes. The Cramer-Rao bound is computed here from the true parameters, sample by sample, with the two
unknown angles of each field projected off; its median is that of errors drawn from it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests/joint"))

from joint_cases import BASELINE_M, Drawn, drawn, fitted, tensor_error

from magtensor.calibration.types import ArrayCalibration
from magtensor.errors import DataError
from magtensor_methods.chi2017 import chi2017, procrustes
from magtensor_methods.li2018 import li2018
from magtensor_methods.yin2014 import yin2014, yin2014_linear

Array = NDArray[np.float64]
NOISE_NT = 1.0
TILTS = (None, 40.0, 20.0)


def two_steps(survey: Drawn, single: Callable[..., object], align: Callable[..., ArrayCalibration]) -> ArrayCalibration:
    """Each sensor alone against the total field, then all into the frame of the first."""
    each = [single(survey.raw[:, s], survey.total_field, worst_error=1.0) for s in range(survey.raw.shape[1])]
    b = np.stack([c.apply(survey.raw[:, s]) for s, c in enumerate(each)], axis=1)  # type: ignore[attr-defined]
    return align(b, each, 0)


METHODS: dict[str, Callable[[Drawn], ArrayCalibration]] = {
    "joint": fitted,
    "Chi 2017": lambda s: two_steps(s, chi2017, procrustes),
    "Yin 2014": lambda s: two_steps(s, yin2014, yin2014_linear),
    "Li 2018": lambda s: li2018(s.raw, s.total_field, worst_error=1.0),
}


def bound(survey: Drawn) -> Array:
    """Covariance (12 S, 12 S) of every sensor's C, row by row, and o, that no unbiased estimate undercuts."""
    sensors = len(survey.forward)
    information = np.zeros((12 * sensors, 12 * sensors))
    for start in range(0, len(survey.field), 500):
        field = survey.field[start : start + 500]
        unit = field / np.linalg.norm(field, axis=1, keepdims=True)
        some = np.where(np.abs(unit[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
        first = np.cross(unit, some)
        tangents = np.stack([first, np.cross(unit, first)], axis=2)  # the length is known, the direction is not
        seen = np.concatenate([survey.forward[s] @ tangents for s in range(sensors)], axis=1) / NOISE_NT
        jacobian = np.zeros((len(field), 3 * sensors, 12 * sensors))
        for s in range(sensors):
            for i in range(3):
                jacobian[:, 3 * s + i, 12 * s + 3 * i : 12 * s + 3 * i + 3] = field / NOISE_NT
                jacobian[:, 3 * s + i, 12 * s + 9 + i] = 1.0 / NOISE_NT
        q = np.linalg.qr(seen)[0]
        rows = (jacobian - q @ (q.swapaxes(1, 2) @ jacobian)).reshape(-1, 12 * sensors)
        information += rows.T @ rows
    scale = 1.0 / np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    root = scale[:, None] * vectors[:, 3:] / np.sqrt(values[3:])  # the common rotation is nobody's to know
    out: Array = root @ root.T
    return out


def errors_of_bound(survey: Drawn, fresh: Drawn, draws: int, rng: np.random.Generator) -> list[float]:
    """Tensor errors of parameters drawn about the truth with the bound for their covariance."""
    covariance = bound(survey)
    values, vectors = np.linalg.eigh(covariance)
    found = []
    for _ in range(draws):
        error = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
        b = []
        for s, own in enumerate(error.reshape(-1, 12)):
            moved = fresh.field @ own[:9].reshape(3, 3).T + own[9:]
            b.append(moved @ np.linalg.inv(survey.forward[s]).T)
        x, y = (b[0] - b[2]) / BASELINE_M, (b[1] - b[3]) / BASELINE_M
        found.append(float(np.sqrt(np.mean(np.column_stack([x, y[:, 1], y[:, 2]]) ** 2))))
    return found


def fresh_of(survey: Drawn, seed: int, tilt: float | None) -> Drawn:
    """The same array in attitudes of the same kind that no fit has seen."""
    other = drawn(seed + 500_000, 400, tilt_deg=tilt)
    return replace(other, forward=survey.forward, offset=survey.offset)


def accuracy(tilts: Sequence[float | None], counts: Sequence[int], runs: int) -> None:
    """Print the table against the bound; of long surveys only some go through the slower methods and the bound."""
    print("| attitudes | samples | surveys | bound | " + " | ".join(METHODS) + " | joint / bound |")
    print("|---" * (5 + len(METHODS)) + "|")
    for tilt in tilts:
        for samples in counts:
            errors: dict[str, list[float]] = {name: [] for name in METHODS}
            refused = dict.fromkeys(METHODS, 0)
            least: list[float] = []
            rng = np.random.default_rng(samples)
            slower = min(runs, 40_000 // samples + 6)
            for run in range(runs):
                seed = 1000 * samples + run
                survey = drawn(seed, samples, tilt_deg=tilt, noise_nT=NOISE_NT)
                fresh = fresh_of(survey, seed, tilt)
                if run < max(slower, 30):
                    least += errors_of_bound(survey, fresh, 20, rng)
                for name, method in METHODS.items():
                    if name != "joint" and run >= slower:
                        continue
                    try:
                        errors[name].append(tensor_error(fresh, method(survey)))
                    except DataError:
                        refused[name] += 1
            middle = float(np.median(least))
            cells = [
                f"{np.median(e):.3g}" + (f" ({refused[n]} refused)" if refused[n] else "") if e else "all refused"
                for n, e in errors.items()
            ]
            spread = 1.25 * np.std(errors["joint"]) / np.sqrt(len(errors["joint"])) / middle
            where = "any" if tilt is None else f"+-{tilt:.0f} deg"
            ratio = f"{np.median(errors['joint']) / middle:.3f} +- {spread:.3f}"
            print(f"| {where} | {samples} | {runs} | {middle:.3g} | {' | '.join(cells)} | {ratio} |", flush=True)


def spikes(runs: int) -> None:
    """Print what 1 % of spikes of 1000 nT cost."""
    print("| attitudes | samples | sensors | rms error without spikes | with 1 % of 1000 nT | ratio |")
    print("|---|---|---|---|---|---|")
    for tilt in TILTS:
        for samples in (1_000, 100_000):
            pairs = []
            for seed in range(runs if samples < 10_000 else max(runs // 10, 4)):
                survey = drawn(seed, samples, tilt_deg=tilt, noise_nT=NOISE_NT)
                rng = np.random.default_rng(70_000 + seed)
                hit = rng.choice(samples, samples // 100, replace=False)
                raw = survey.raw.copy()
                sign = rng.choice([-1.0, 1.0], len(hit))
                raw[hit, rng.integers(0, 4, len(hit)), rng.integers(0, 3, len(hit))] += 1000.0 * sign
                fresh = fresh_of(survey, seed, tilt)
                pairs.append([tensor_error(fresh, fitted(s)) for s in (survey, replace(survey, raw=raw))])
            without, with_spikes = np.sqrt(np.mean(np.square(pairs), axis=0))
            where = "any" if tilt is None else f"+-{tilt:.0f} deg"
            print(
                f"| {where} | {samples} | 4 | {without:.4g} | {with_spikes:.4g} | {with_spikes / without:.3f} |",
                flush=True,
            )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few and short surveys")
    parser.add_argument("--tilts", type=float, nargs="*", help="deg; 0 for any attitude; default: all")
    parser.add_argument("--samples", type=int, nargs="*", default=[12, 30, 200, 2_000, 20_000])
    parser.add_argument("--runs", type=int, default=200)
    chosen = parser.parse_args()
    tilts = TILTS if chosen.tilts is None else [tilt or None for tilt in chosen.tilts]
    if chosen.quick:
        accuracy(tilts, (12, 200), 5)
    else:
        accuracy(tilts, chosen.samples, chosen.runs)
    print()
    spikes(4 if chosen.quick else 60)


if __name__ == "__main__":
    main()
