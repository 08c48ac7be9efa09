"""A base station or sensors that wander: what the loop accuses them of.

    python studies/wandering.py --rows build/wandering.jsonl --page docs/wandering.md

No two places have the same variation, and no sensor keeps its offset. Each trial is a survey without any effect,
simulated as for loop_power.md (four sensors with 0.15 nT of white noise each axis and 1/f noise, half an hour of
tumbling or of turning with tilts within 40 degrees, or 136 static postures), to which a smooth wandering is added, to
the base station's readings, to the axes of one sensor or to those of all: white noise through two first-order lags of
the time given, scaled to the rms given, each axis its own. Or it is restless for a while: the same under a parabola
eight times that time wide, somewhere in the survey. It goes through the whole search, with every error model.

- **event**: something that happens once was adopted, a jump or a passing source. There is none; where it was restless
  for a while one smooth swing is like a vehicle that passes.
- **slow**: of the base station a drift, a clock or a scale factor of the reference, of sensors a drift of offsets or a
  warming up, which is what it is, or nearly so.
- **other**: anything else was adopted, which would have another cause.
- **told**: nothing was adopted, and something unexplained is told; **silent**: nothing at all.
"""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import h5py
import numpy as np
import trials
from loop_surveys import MOTIONS, recorded, scenario
from scipy.signal import lfilter

from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.searching.contribution import happens_once
from magtensor.loop.searching.search import search
from magtensor.loop.searching.unexplained import unexplained
from magtensor.registry import Registry
from magtensor.simulate import simulate

TIMES_S, RMS_NT = (30.0, 100.0, 300.0, 1000.0), (0.05, 0.1, 0.2)
RESTLESS_S, RESTLESS_NT = (5.0, 15.0, 40.0), (0.5, 2.0)
FOR_A_WHILE = ", for a while"
WIDTH = 8.0  # times the time of the lags, in which it is restless
KINDS = ("event", "slow", "other", "told", "silent")
WHO = ("base station", "one sensor", "all sensors", f"base station{FOR_A_WHILE}", f"one sensor{FOR_A_WHILE}")
DRIFTS = ("offset_drift", "warm_up")
FIRST_SEED = 6000  # 5000 to 5001 are those on which it was found what thermometers seen through hours are taken for


class Trial(NamedTuple):
    """One survey."""

    who: str
    motion: str
    time_s: float
    rms_nT: float
    seed: int


@cache
def models() -> list[Component]:
    """Every error model."""
    registry = Registry.load()
    return [registry.find("error_model", name) for name in registry.names("error_model")]


def wander(path: Path, trial: Trial) -> None:
    """Add the wandering to a survey's file."""
    rng = np.random.default_rng(seeds_of(trial))
    with h5py.File(path, "a") as file:
        if trial.who.startswith("base station"):
            readings = file["reference/total_field"]
            readings[:] = readings[:] + course(rng, trial, file["reference/time"][:])
            return
        outputs = file["b_raw"]
        for sensor in range(1 if trial.who.startswith("one sensor") else outputs.shape[1]):
            for axis in range(3):
                outputs[:, sensor, axis] = outputs[:, sensor, axis] + course(rng, trial, file["time"][:])


def seeds_of(trial: Trial) -> list[int]:
    """Of its wandering."""
    return [trial.seed, round(trial.time_s), round(1e3 * trial.rms_nT)]


def course(rng: np.random.Generator, trial: Trial, time: Array) -> Array:
    """(N,) nT at times (N,), which need not be even."""
    every = float(np.median(np.diff(time)))
    even = np.arange(-20.0 * trial.time_s, np.ptp(time) + every, every)
    out, keep = rng.standard_normal(len(even)), np.exp(-every / trial.time_s)
    for _ in range(2):
        out = lfilter([1.0 - keep], [1.0, -keep], out)
    out = np.interp(time - time[0], even, out)
    if not trial.who.endswith(FOR_A_WHILE):
        return np.asarray(trial.rms_nT * (out - out.mean()) / out.std())
    middle = np.random.default_rng([*seeds_of(trial), 1]).uniform(0.15, 0.85) * np.ptp(time)
    window = np.maximum(1.0 - ((time - time[0] - middle) / (WIDTH / 2.0 * trial.time_s)) ** 2, 0.0)
    within = (out - np.average(out, weights=window)) * window
    return np.asarray(trial.rms_nT * within / np.sqrt(np.average(within**2, weights=window)))


def tried(trial: Trial) -> dict[str, Any]:
    """The row of a trial."""
    record = recorded(simulate(scenario(trial.motion, 0.02, trial.seed)), partial(wander, trial=trial))
    found = search(record, models(), Fitting())
    left = unexplained(found, record)["present"]
    adopted = found.last.adopted
    if any(happens_once(a) for a in adopted):
        kind = "event"
    elif any(not slow(a, trial.who) for a in adopted):
        kind = "other"
    else:
        kind = "slow" if adopted else "told" if left else "silent"
    return {**trial._asdict(), "kind": kind, "adopted": [a.name for a in adopted]}


def slow(adopted: Adopted, who: str) -> bool:
    """Whether it is what wanders, or nearly so."""
    return adopted.component.effect == "reference" if who.startswith("base station") else adopted.name in DRIFTS


def line(row: dict[str, Any]) -> str:
    """A row in words."""
    names = f" ({', '.join(row['adopted'])})" if row["adopted"] else ""
    survey = f"{row['who']}, {row['motion']}, {row['rms_nT']:g} nT, {row['time_s']:g} s, seed {row['seed']}"
    return f"{survey}: {row['kind']}{names}"


def counted(kinds: Sequence[str]) -> str:
    """The cells of a row."""
    counts = Counter(kinds)
    return " | ".join(str(counts[kind]) for kind in KINDS)


def strengths(who: str) -> tuple[Sequence[float], Sequence[float]]:
    """The times, s, and rms, nT, of what wanders."""
    return (RESTLESS_S, RESTLESS_NT) if who.endswith(FOR_A_WHILE) else (TIMES_S, RMS_NT)


def page(command: str, rows: Sequence[dict[str, Any]], open_: int) -> str:
    """The study's page."""
    words = (__doc__ or "").split("\n\n", 2)[2]
    lines = ["# What wanders", "", words, f"`{command}`", ""]
    if open_:
        lines += [f"{open_} surveys are still to be made.", ""]
    lines += [f"| what wanders | motion | rms, nT | surveys | {' | '.join(KINDS)} |", "|" + "---|" * (4 + len(KINDS))]
    for who in WHO:
        for motion in MOTIONS:
            for rms in strengths(who)[1]:
                own = [r["kind"] for r in rows if (r["who"], r["motion"], r["rms_nT"]) == (who, motion, rms)]
                if own:
                    lines.append(f"| {who} | {motion} | {rms:g} | {len(own)} | {counted(own)} |")
    lines += [f"| all | | | {len(rows)} | {counted([r['kind'] for r in rows])} |", ""]
    if named := [f"- {line(r)}" for r in rows if r["kind"] in ("event", "other")]:
        lines += ["## Accused wrongly", "", *named, ""]
    return "\n".join(lines)


def planned(seeds: int) -> Iterator[Trial]:
    """All trials, every kind of survey before a second one of any."""
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        for who in WHO:
            times, strong = strengths(who)
            for motion, rms, time_s in itertools.product(MOTIONS, strong, times):
                yield Trial(who, motion, time_s, rms, seed)


def main() -> None:
    """Run what is missing and write the page."""
    trials.study(__file__, __doc__, Trial, planned, tried, line, page)


if __name__ == "__main__":
    main()
