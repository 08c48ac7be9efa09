"""The joint fit without a reference, of several surveys, and with an attitude, against the bound that noise sets.

`python studies/joint_surveys.py` prints the tables of docs/joint_surveys.md. Surveys are those of
tests/joint/several_cases.py, changing_cases.py and effects_cases.py (the array of METHODS A4.8, 1 nT of noise, without
the product's simulator). The first column of figures, error over bound, is the rms error of all parameters of all
surveys, measured by the Cramer-Rao information and over the number of determined parameters: 1 at the bound. The
information is computed there from the true parameters, sample by sample, with the unknown direction of each field
projected off, and its size where that is an unknown constant. Behind it stands its standard error. Standardised
errors are over the standard deviations that the fit states, all parameters pooled.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests/joint"))

import changing_cases
import effects_cases
import several_cases
from several_cases import Case

from magtensor_effects.temperature import temperature_offset, temperature_scale

CASES: dict[str, Sequence[tuple[str, Case | changing_cases.Case]]] = {
    "Without a scalar reference": [
        (f"{s} sensor{'s' * (s > 1)}, {words}, {n} samples, {g} unknown constant{'s' * (g > 1)}",
         Case(samples=(n,), sensors=s, tilt_deg=tilt, levels=g))
        for s, n, g, tilt, words in (
            (1, 400, 1, None, "any attitude"), (4, 400, 1, None, "any attitude"), (4, 40, 1, None, "any attitude"),
            (4, 400, 1, 20.0, "+-20 deg"), (4, 400, 10, None, "any attitude"), (4, 400, 10, 40.0, "+-40 deg"),
            (1, 2000, 20, 40.0, "+-40 deg"), (4, 2000, 20, 20.0, "+-20 deg"),
        )
    ],
    "Several surveys": [
        ("4 sensors, 200 + 100 + 50, any attitude, own offsets", Case(samples=(200, 100, 50))),
        ("4 sensors, 200 + 100 + 50, +-20 deg, own offsets", Case(samples=(200, 100, 50), tilt_deg=20.0)),
        ("4 sensors, 200 + 100 + 50, +-20 deg, common offsets",
         Case(samples=(200, 100, 50), tilt_deg=20.0, apart_nT=0.0)),
        ("1 sensor, 200 + 200, +-40 deg, own offsets", Case(samples=(200, 200), sensors=1, tilt_deg=40.0)),
        ("4 sensors, 6 x 8 postures, any attitude, own offsets", Case(samples=(8,) * 6)),
        ("4 sensors, 6 x 8 postures, +-40 deg, own offsets", Case(samples=(8,) * 6, tilt_deg=40.0)),
        ("4 sensors, 20 x 40, +-40 deg, offsets 1000 nT apart",
         Case(samples=(40,) * 20, tilt_deg=40.0, apart_nT=1000.0)),
        ("4 sensors, 3 x 150, any attitude, a constant field unknown in each",
         Case(samples=(150,) * 3, levels=1)),
    ],
    "Several surveys whose C changes with the date": [
        (words, changing_cases.Case(samples=samples, years=years, **options))
        for words, samples, years, options in (
            ("4 sensors, 150 + 100 + 100 + 50 in 2.5 years, any attitude, own offsets",
             (150, 100, 100, 50), (0.0, 0.4, 1.1, 2.5), {}),
            ("4 sensors, the same, +-20 deg, own offsets",
             (150, 100, 100, 50), (0.0, 0.4, 1.1, 2.5), {"tilt_deg": 20.0}),
            ("4 sensors, the same, +-40 deg, common offsets",
             (150, 100, 100, 50), (0.0, 0.4, 1.1, 2.5), {"tilt_deg": 40.0, "offsets": "common"}),
            ("4 sensors, the same, +-40 deg, offsets linear in the date",
             (150, 100, 100, 50), (0.0, 0.4, 1.1, 2.5), {"tilt_deg": 40.0, "offsets": "linear"}),
            ("4 sensors, 200 + 200 a year apart, any attitude, own offsets", (200, 200), (0.0, 1.0), {}),
            ("4 sensors, 6 x 8 postures in 5 years, any attitude, common offsets",
             (8,) * 6, tuple(range(6)), {"offsets": "common"}),
            ("1 sensor, 200 + 200 + 200 in 2 years, +-40 deg, own offsets",
             (200,) * 3, (0.0, 1.0, 2.0), {"sensors": 1, "tilt_deg": 40.0}),
            ("4 sensors, 3 x 150, +-40 deg, own offsets, attitude to 0.1 deg",
             (150,) * 3, (0.0, 1.0, 2.0), {"tilt_deg": 40.0, "attitude_deg": 0.1}),
        )
    ],
    "With an attitude and a known field": [
        (f"{s} sensor{'s' * (s > 1)}, {n} samples, {words}, attitude to {deg:g} deg",
         Case(samples=(n,), sensors=s, tilt_deg=tilt, attitude_deg=deg))
        for s, n, tilt, words, deg in (
            (4, 400, None, "any attitude", 0.5), (4, 400, 20.0, "+-20 deg", 0.5), (4, 400, 20.0, "+-20 deg", 0.01),
            (1, 400, 20.0, "+-20 deg", 0.1), (4, 2000, 40.0, "+-40 deg", 0.2), (4, 40, 40.0, "+-40 deg", 0.5),
        )
    ] + [("4 sensors, 200 + 200, +-40 deg, own offsets, attitude to 0.1 deg",
          Case(samples=(200, 200), tilt_deg=40.0, attitude_deg=0.1))],
}  # fmt: skip


LATER = "A survey at another date"
_SIX = (0.0, 0.3, 0.8, 1.4, 1.9, 2.4)
LATER_CASES = [
    (f"{words}, {years:g} year{'s' * (years != 1)} after the first", years,
     changing_cases.Case(samples=(100,) * len(dates), years=dates, offsets=offsets, tilt_deg=40.0, scatter=scatter))
    for words, dates, years, offsets, scatter in (
        ("6 surveys in 2.4 years, common offsets", _SIX, 1.0, "common", 0.0),
        ("6 surveys in 2.4 years, common offsets", _SIX, 4.0, "common", 0.0),
        ("6 surveys in 2.4 years, offsets linear", _SIX, 4.0, "linear", 0.0),
        ("the same, C scattered by 1e-4 about the line", _SIX, 4.0, "linear", 1e-4),
        ("3 surveys in 2 years, C scattered by 1e-4 about the line", (0.0, 1.0, 2.0), 3.0, "common", 1e-4),
    )
]  # fmt: skip


def later_table(runs: int) -> None:
    """Print the table of surveys that were not in the fit."""
    print(f"## {LATER}\n")
    print("| case | fits | variance of standardised errors | inside 95 % | the same of the rates | inside 95 % |")
    print("|---|---|---|---|---|---|", flush=True)
    for words, years, case in LATER_CASES:
        draws = [changing_cases.at_another_date(changing_cases.surveys(s, case), years, s) for s in range(runs)]
        told = []
        for values in zip(*draws, strict=True):
            pooled = np.array(values)
            told.append(f"{np.mean(pooled**2):.3f} | {100 * np.mean(np.abs(pooled) < 1.96):.1f} %")
        print(f"| {words} | {runs} | {' | '.join(told)} |", flush=True)
    print()


EFFECTS = "With declared effects"
EFFECTS_CASES = [
    ("300 + 200, own offsets, offsets follow", Case(samples=(300, 200), tilt_deg=40.0), temperature_offset, 0.0),
    ("300 + 200, common offsets, scale factors follow", Case(samples=(300, 200), tilt_deg=40.0, apart_nT=0.0),
     temperature_scale, 0.0),
    ("5 x 12 postures, +-60 deg, own offsets, offsets follow", Case(samples=(12,) * 5, tilt_deg=60.0),
     temperature_offset, 0.0),
    ("1 sensor, 300 + 300, +-60 deg, own offsets, offsets follow", Case(samples=(300, 300), sensors=1, tilt_deg=60.0),
     temperature_offset, 0.0),
    ("300 + 200, +-60 deg, 2 x 3 unknown constants, offsets follow", Case(samples=(300, 200), levels=3, tilt_deg=60.0),
     temperature_offset, 0.0),
    ("400, attitude to 0.3 deg, offsets follow", Case(samples=(400,), tilt_deg=40.0, attitude_deg=0.3),
     temperature_offset, 0.0),
    ("200 + 200, attitude to 0.05 deg, scale factors follow",
     Case(samples=(200, 200), tilt_deg=40.0, attitude_deg=0.05), temperature_scale, 0.0),
    ("3000, offsets follow, slow noise", Case(samples=(3000,), tilt_deg=40.0), temperature_offset, 0.5),
    ("2000 + 1500, own offsets, offsets follow, slow noise", Case(samples=(2000, 1500), tilt_deg=40.0),
     temperature_offset, 0.5),
    ("2000 + 1500, 2 x 2 unknown constants, offsets follow, slow noise",
     Case(samples=(2000, 1500), levels=2, tilt_deg=40.0), temperature_offset, 0.5),
    ("3000, attitude to 0.2 deg, offsets follow, slow noise", Case(samples=(3000,), tilt_deg=40.0, attitude_deg=0.2),
     temperature_offset, 0.5),
]  # fmt: skip


def effects_table(runs: int) -> None:
    """Print the table of fits with error models."""
    print(f"## {EFFECTS}\n")
    print(
        "| case | fits | variance of standardised errors of C, o | of coefficients | inside 95 % | Mahalanobis / rank |"
    )
    print("|---|---|---|---|---|---|", flush=True)
    for words, case, model, slow_nT in EFFECTS_CASES:
        pooled, coefficients, squares = [], [], []
        for seed in range(runs):
            of = effects_cases.warmed(seed, case, model)
            of = effects_cases.with_slow_noise(of, seed, slow_nT) if slow_nT else of
            found = effects_cases.calibrated(of, effects_cases.fitted(of))
            error = effects_cases.parameters(found) - effects_cases.true_parameters(of)
            covariance = effects_cases.joint_covariance(found)
            z = error / np.sqrt(np.diag(covariance))
            pooled.append(z[: -len(found.values)])
            coefficients.append(z[-len(found.values) :])
            square, rank = effects_cases.square(error, covariance)
            squares.append(square / rank)
        told = [f"{np.mean(np.square(part)):.3f}" for part in (pooled, coefficients)]
        inside = f"{100 * np.mean(np.abs(np.concatenate([*pooled, *coefficients])) < 1.96):.1f} %"
        print(f"| {words} | {runs} | {' | '.join(told)} | {inside} | {np.mean(squares):.3f} |", flush=True)
    print()


def errors_of(seed: int, case: Case | changing_cases.Case) -> several_cases.Errors:
    """Of one draw."""
    if isinstance(case, changing_cases.Case):
        return changing_cases.errors(changing_cases.surveys(seed, case))
    return several_cases.errors(several_cases.surveys(seed, case))


def table(name: str, cases: Sequence[tuple[str, Case | changing_cases.Case]], runs: int) -> None:
    """Print one table."""
    print(f"## {name}\n")
    print("| case | fits | error / bound | variance of standardised errors | inside 95 % | Mahalanobis / rank |")
    print("|---|---|---|---|---|---|", flush=True)
    for words, case in cases:
        found = [errors_of(seed, case) for seed in range(runs)]
        pooled = np.array([f.standardised for f in found])
        by_bound = np.array([f.by_bound for f in found])
        ratio = np.sqrt(by_bound.mean())
        spread = by_bound.std(ddof=1) / np.sqrt(runs) / (2 * ratio)
        print(
            f"| {words} | {runs} | {ratio:.3f} +- {spread:.3f} | {np.mean(pooled**2):.3f} | "
            f"{100 * np.mean(np.abs(pooled) < 1.96):.1f} % | {np.mean([f.square for f in found]):.3f} |",
            flush=True,
        )
    print()


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--table", choices=[*CASES, LATER, EFFECTS], help="one of them alone")
    chosen = parser.parse_args()
    for name, cases in CASES.items():
        if chosen.table in (None, name):
            table(name, cases, chosen.runs)
    if chosen.table in (None, LATER):
        later_table(chosen.runs)
    if chosen.table in (None, EFFECTS):
        effects_table(chosen.runs)


if __name__ == "__main__":
    main()
