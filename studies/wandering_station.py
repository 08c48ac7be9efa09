"""A base station that wanders beside the site: what the loop accuses it of.

    python studies/wandering_station.py --rows build/wandering_station.jsonl --page docs/wandering_station.md

No two places have the same variation. Each trial is a survey without any effect, simulated as for loop_power.md (four
sensors with 0.15 nT of white noise each axis and 1/f noise, half an hour of tumbling or of turning with tilts within 40
degrees, or 136 static postures), to whose base station's readings a smooth difference is added: white noise through two
first-order lags of the time given, scaled to the rms given. It goes through the whole search, with every error model.

- **event**: something that happens once was adopted, a jump or a passing source. There is none.
- **slow**: a drift, a clock or a scale factor of the reference, which is what it is, or nearly so.
- **other**: anything else was adopted, which would be the instrument's or the site's.
- **told**: nothing was adopted, and something unexplained is told; **silent**: nothing at all.
"""

from __future__ import annotations

import argparse
import os
import sys
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

from magtensor.components import Component
from magtensor.loop.fitting.model import Fitting
from magtensor.loop.searching.contribution import happens_once
from magtensor.loop.searching.search import search
from magtensor.loop.searching.unexplained import unexplained
from magtensor.registry import Registry
from magtensor.simulate import simulate

TIMES_S = (30.0, 100.0, 300.0, 1000.0)
RMS_NT = (0.05, 0.1, 0.2)
KINDS = ("event", "slow", "other", "told", "silent")
FIRST_SEED = 6000  # 5000 to 5001 are those on which it was found what thermometers seen through hours are taken for


class Trial(NamedTuple):
    """One survey."""

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
    """Add the difference to the base station's readings in a survey's file."""
    rng = np.random.default_rng([trial.seed, round(trial.time_s), round(1e3 * trial.rms_nT)])
    with h5py.File(path, "a") as file:
        every = float(np.median(np.diff(file["reference/time"][:])))
        readings = file["reference/total_field"]
        course = rng.standard_normal(len(readings) + round(20.0 * trial.time_s / every))
        keep = np.exp(-every / trial.time_s)
        for _ in range(2):
            course = lfilter([1.0 - keep], [1.0, -keep], course)
        course = course[-len(readings) :] - course[-len(readings) :].mean()
        readings[:] = readings[:] + trial.rms_nT * course / course.std()


def tried(trial: Trial) -> dict[str, Any]:
    """The row of a trial."""
    record = recorded(simulate(scenario(trial.motion, 0.02, trial.seed)), partial(wander, trial=trial))
    found = search(record, models(), Fitting())
    left = unexplained(found, record)["present"]
    adopted = found.last.adopted
    if any(happens_once(a) for a in adopted):
        kind = "event"
    elif any(a.component.effect != "reference" for a in adopted):
        kind = "other"
    else:
        kind = "slow" if adopted else "told" if left else "silent"
    return {**trial._asdict(), "kind": kind, "adopted": [a.name for a in adopted]}


def line(row: dict[str, Any]) -> str:
    """A row in words."""
    names = f" ({', '.join(row['adopted'])})" if row["adopted"] else ""
    return f"{row['motion']}, {row['rms_nT']:g} nT, {row['time_s']:g} s, seed {row['seed']}: {row['kind']}{names}"


def page(command: str, rows: Sequence[dict[str, Any]], open_: int) -> str:
    """The study's page."""
    words = (__doc__ or "").split("\n\n", 2)[2]
    lines = ["# A base station that wanders beside the site", "", words, f"`{command}`", ""]
    if open_:
        lines += [f"{open_} surveys are still to be made.", ""]
    lines += [f"| motion | rms, nT | time, s | surveys | {' | '.join(KINDS)} |", "|" + "---|" * (4 + len(KINDS))]
    for motion in MOTIONS:
        for rms in RMS_NT:
            for time_s in TIMES_S:
                own = [r["kind"] for r in rows if (r["motion"], r["rms_nT"], r["time_s"]) == (motion, rms, time_s)]
                counts = Counter(own)
                if own:
                    cells = " | ".join(str(counts[kind]) for kind in KINDS)
                    lines.append(f"| {motion} | {rms:g} | {time_s:g} | {len(own)} | {cells} |")
    every = Counter(r["kind"] for r in rows)
    lines += [f"| all | | | {len(rows)} | {' | '.join(str(every[kind]) for kind in KINDS)} |", ""]
    if named := [f"- {line(r)}" for r in rows if r["kind"] in ("event", "other")]:
        lines += ["## Accused wrongly", "", *named, ""]
    return "\n".join(lines)


def planned(seeds: int) -> Iterator[Trial]:
    """All trials, every kind of survey before a second one of any."""
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        for motion in MOTIONS:
            for rms in RMS_NT:
                for time_s in TIMES_S:
                    yield Trial(motion, time_s, rms, seed)


def main() -> None:
    """Run what is missing and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    trials.add_options(parser)
    parser.add_argument("--page", type=Path, help="write the table here")
    parser.add_argument("--seeds", type=int, default=2, help="surveys of each motion, rms and time")
    chosen = parser.parse_args()
    rows, open_ = trials.rows_of(chosen, planned(chosen.seeds), trials.named(Trial), tried, line)
    if chosen.page:
        chosen.page.write_text(page(f"python studies/wandering_station.py {' '.join(sys.argv[1:])}", rows, open_))


if __name__ == "__main__":
    main()
