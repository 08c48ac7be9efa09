"""Clean surveys whose base station is read seldom, or misses readings: what the loop accuses them of.

    python studies/base_station.py --rows build/base_station.jsonl --page docs/base_station.md

Each trial is a survey without any effect, simulated as for loop_power.md (four sensors with 0.15 nT of white noise each
axis and 1/f noise, half an hour of tumbling), in a field with two pulsations of the rms given on each axis, of the
period given and 1.7 times that, beside the usual slow variation. Its base station is read every so many seconds, with
white noise of the size given; or it has lost three readings in the middle. The search has every error model.

- **accused**: something was adopted; **told**: nothing was, but something unexplained is told.
- **seldom**: neither, and the description says that the base station is read too seldom; **silent**: nothing at all.

|b| - F is the error of the total field beside the sensors' noise, with nothing taken off.
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
from loop_surveys import recorded, scenario

from magtensor.components import Component
from magtensor.loop.fitting.model import Fitting
from magtensor.loop.searching.search import search
from magtensor.loop.searching.unexplained import slow_along, unexplained
from magtensor.registry import Registry
from magtensor.simulate import simulate

EVERY_S = (1.0, 2.0, 5.0, 10.0, 30.0, 60.0)
PERIODS_S, RMS_NT = (22.0, 60.0), (1.0, 3.0)
NOISE_NT = (0.02, 0.3)
LOST = 3  # readings
MOST_S = 10.0  # between readings of a station that loses some: what is further apart is no gap any more
KINDS = ("accused", "told", "seldom", "silent")
FIRST_SEED = 7100


class Trial(NamedTuple):
    """One survey."""

    every_s: float
    period_s: float
    rms_nT: float
    noise_nT: float
    lost: int
    seed: int


@cache
def models() -> list[Component]:
    """Every error model."""
    registry = Registry.load()
    return [registry.find("error_model", name) for name in registry.names("error_model")]


def lose(path: Path, lost: int) -> None:
    """Leave some readings out of a survey's file."""
    with h5py.File(path, "a") as file:
        station = file["reference"]
        middle = len(station["time"]) // 2
        for name in ("time", "total_field"):
            values, facts = np.delete(station[name][:], slice(middle, middle + lost)), dict(station[name].attrs)
            del station[name]
            station[name] = values
            station[name].attrs.update(facts)


def tried(trial: Trial) -> dict[str, Any]:
    """The row of a trial."""
    made = scenario("tumbling", 0.02, trial.seed)
    waves = [{"rms_nT": trial.rms_nT, "period_s": factor * trial.period_s} for factor in (1.0, 1.7)]
    made["field"]["variation"] |= {"pulsations": waves}
    made["base_station"] |= {"rate_Hz": 1.0 / trial.every_s, "noise_sd_nT": trial.noise_nT}
    record = recorded(simulate(made), partial(lose, lost=trial.lost))
    found = search(record, models(), Fitting())
    left = unexplained(found, record)
    adopted = [a.name for a in found.last.adopted]
    quiet = "seldom" if "read too seldom" in left["description"] else "silent"
    kind = "accused" if adopted else "told" if left["present"] else quiet
    return {**trial._asdict(), "kind": kind, "adopted": adopted, "slow_nT": slow_along(found.first)}


def line(row: dict[str, Any]) -> str:
    """A row in words."""
    names = f" ({', '.join(row['adopted'])})" if row["adopted"] else ""
    lost = f", {row['lost']} lost" if row["lost"] else ""
    return (
        f"every {row['every_s']:g} s{lost}, pulsations of {row['rms_nT']:g} nT, {row['period_s']:g} s, "
        f"noise {row['noise_nT']:g} nT: {row['kind']}{names}, {row['slow_nT']:.2f} nT of |b| - F"
    )


def page(command: str, rows: Sequence[dict[str, Any]], open_: int) -> str:
    """The study's page."""
    words = (__doc__ or "").split("\n\n", 2)[2]
    lines = ["# Base stations that are read seldom", "", words, f"`{command}`", ""]
    if open_:
        lines += [f"{open_} surveys are still to be made.", ""]
    lines += [
        f"| read every, s | readings lost | surveys | {' | '.join(KINDS)} | \\|b\\| - F, nT |",
        "|" + "---|" * (4 + len(KINDS)),
    ]
    for lost, every in itertools.product((0, LOST), EVERY_S):
        own = [r for r in rows if (r["lost"], r["every_s"]) == (lost, every)]
        if own:
            counts, slow = Counter(r["kind"] for r in own), [r["slow_nT"] for r in own]
            cells = " | ".join(str(counts[kind]) for kind in KINDS)
            lines.append(f"| {every:g} | {lost} | {len(own)} | {cells} | {min(slow):.2f} to {max(slow):.2f} |")
    counts = Counter(r["kind"] for r in rows)
    lines += [f"| all | | {len(rows)} | {' | '.join(str(counts[kind]) for kind in KINDS)} | |", ""]
    if named := [f"- {line(r)}" for r in rows if r["kind"] in ("accused", "told")]:
        lines += ["## Accused or told", "", *named, ""]
    return "\n".join(lines)


def planned(seeds: int) -> Iterator[Trial]:
    """All trials; each has a field of its own."""
    cells = list(itertools.product((0, LOST), EVERY_S, PERIODS_S, RMS_NT, NOISE_NT))
    for number, (lost, every, period, rms, noise) in enumerate(cells * seeds):
        if not lost or every <= MOST_S:
            yield Trial(every, period, rms, noise, lost, FIRST_SEED + number)


def main() -> None:
    """Run what is missing and write the page."""
    trials.study(__file__, __doc__, Trial, planned, tried, line, page)


if __name__ == "__main__":
    main()
