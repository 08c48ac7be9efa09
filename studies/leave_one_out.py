"""What the loop does about an effect that its catalogue lacks: each error model left out in turn.

    python studies/leave_one_out.py --rows build/leave_one_out.jsonl --page docs/leave_one_out.md --seconds 900

Each trial is a survey simulated in the time domain anew (as in `loop_power.py`: four sensors, 0.15 nT of white noise
an axis and 1/f noise of 0.02 nT/rtHz at 1 Hz, half an hour of tumbling), with one effect of a given rms over the white
noise. It goes through the whole search with every error model but that of the effect.

- **told**: nothing is adopted, and the verdict says that something unexplained is left, and describes it.
- **rival**: another model is adopted in its place. `held out` is |b| - F on blocks that no fit has seen, before and
  after; it **predicts** if that falls, or if each adopted model lowers the residual on held-out blocks. `left` is the
  rms of what remains in units of the white noise (about 1.1 with the 1/f noise alone). It **remains** if the verdict
  says that something unexplained is left.
- **silent**: nothing is adopted, and nothing is said.

A rival may be the same model under another name: `channel_response` of the thermometer is `temperature_offset`.

Rows that exist are not made again: the command goes on where it stopped, and writes the page from all of them.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import trials
from loop_power import Trial, models, simulated
from loop_surveys import EFFECTS, recorded

from magtensor.errors import MagtensorError
from magtensor.loop.fitting.errors_before_after import folds_for, held_out, held_out_error
from magtensor.loop.fitting.model import Fitting
from magtensor.loop.searching.contribution import removal
from magtensor.loop.searching.search import search
from magtensor.loop.searching.unexplained import unexplained

FIRST_SEED = 5000
NOISE = "white and 1/f"
LEFT = 1.2  # times the white noise: more than the 1/f noise leaves
HEAD = (
    "left out", "rms / noise", "surveys", "told", "rival", "predicts", "remains", "silent", "held out, nT", "left",
    "rivals; or what is said",
)  # fmt: skip


def tried(trial: Trial) -> dict[str, Any]:
    """The row of one trial."""
    row: dict[str, Any] = trial._asdict()
    how = Fitting()
    try:
        record = recorded(simulated(trial))
        found = search(record, [m for name, m in models().items() if name != trial.effect], how)
    except MagtensorError as error:
        return row | {"outcome": "cannot be", "description": str(error).splitlines()[0]}
    last = found.last
    left = unexplained(found, found.record)
    keep, folds = last.fit.keep, folds_for(last)
    before = held_out(record, [], how, [], keep, folds)
    after = held_out(found.record, last.adopted, how, last.theta, keep, folds)
    return row | {
        "outcome": "rival" if last.adopted else "told" if left["present"] else "silent",
        "adopted": [a.name for a in last.adopted],
        "present": left["present"],
        "description": left["description"],
        "looks_like": left["looks_like"],
        "left": float(np.sqrt(last.residual.square())),
        "before": _all(held_out_error(record, before, keep)),
        "after": _all(held_out_error(found.record, after, keep)),
        "removal": [removal(last, i) for i in range(len(last.adopted))],
    }


def _all(block: dict[str, Any] | None) -> float | None:
    value = ((block or {}).get("total_field_rms_nT") or {}).get("all")
    return None if value is None else float(value)


def predicts(row: dict[str, Any]) -> bool:
    """Whether what was adopted lowers an error on blocks it has not seen."""
    outright = row["before"] is not None and row["after"] is not None and row["after"] < row["before"]
    return outright or all(after < before for before, after in row["removal"])


def page(rows: Sequence[dict[str, Any]]) -> str:
    """The printed table."""
    rates = " and ".join(f"{r:g}" for r in sorted({row["rate_Hz"] for row in rows}))
    about = (__doc__ or "").split("\n", 2)[2].strip()
    lines = [
        "# Every error model left out in turn",
        "",
        about,
        "",
        f"{len(rows)} surveys so far, at {rates} Hz (`--rate`).",
        "",
    ]
    lines += [f"| {' | '.join(HEAD)} |", "|---" * len(HEAD) + "|"]
    for effect in EFFECTS:
        for amplitude in sorted({r["amplitude"] for r in rows if r["effect"] == effect}):
            lines.append(
                _cells(effect, amplitude, [r for r in rows if (r["effect"], r["amplitude"]) == (effect, amplitude)])
            )
    usable = [r for r in rows if r["outcome"] != "cannot be"]
    rivals = [r for r in usable if r["outcome"] == "rival"]
    quiet = [r for r in rivals if not r["present"] and r["left"] > LEFT]
    lines += [
        "",
        f"Of {len(usable)} surveys {_count(usable, 'told')} were told as unexplained, in {len(rivals)} a rival was "
        f"adopted, and {_count(usable, 'silent')} were passed over in silence. Of the rivals "
        f"{sum(not predicts(r) for r in rivals)} did not predict held-out blocks; {len(quiet)} left more than {LEFT:g} "
        "times the white noise without a word.",
        "",
    ]
    return "\n".join(lines)


def _cells(effect: str, amplitude: float, own: Sequence[dict[str, Any]]) -> str:
    usable = [r for r in own if r["outcome"] != "cannot be"]
    rivals = [r for r in usable if r["outcome"] == "rival"]
    told = [r for r in usable if r["outcome"] == "told"]
    words = [", ".join(sorted({n for r in rivals for n in r["adopted"]})), *(r["description"] for r in told[:1])]
    if len(usable) < len(own):
        words.append(f"{len(own) - len(usable)} could not be calibrated")
    cells = [
        f"`{effect}`", f"{amplitude:g}", str(len(own)), str(len(told)), str(len(rivals)),
        f"{sum(map(predicts, rivals))} of {len(rivals)}" if rivals else "",
        f"{sum(r['present'] for r in rivals)} of {len(rivals)}" if rivals else "",
        str(_count(usable, "silent")), f"{_median(usable, 'before')} -> {_median(usable, 'after')}",
        _median(usable, "left"), "; ".join(w for w in words if w),
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |"


def line(row: dict[str, Any]) -> str:
    """A row, as it is told when it is made."""
    return " ".join([row["effect"], row["outcome"], ", ".join(row.get("adopted", ())), row["description"]])


def _count(rows: Sequence[dict[str, Any]], outcome: str) -> int:
    return sum(r["outcome"] == outcome for r in rows)


def _median(rows: Sequence[dict[str, Any]], key: str) -> str:
    values = [r[key] for r in rows if r.get(key) is not None]
    return f"{np.median(values):.3g}" if values else "unknown"


def main() -> None:
    """Run what is missing and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    trials.add_options(parser)
    parser.add_argument("--page", type=Path, help="write the table here")
    parser.add_argument("--seeds", type=int, default=1, help="surveys of each effect and amplitude")
    parser.add_argument("--effects", default=",".join(EFFECTS))
    parser.add_argument("--amplitudes", default="3", help="rms of the effect in units of the white noise")
    parser.add_argument("--rate", type=float, default=2.0, help="Hz")
    chosen = parser.parse_args()
    planned = [
        Trial(effect, float(amplitude), "tumbling", NOISE, seed, chosen.rate)
        for seed in range(FIRST_SEED, FIRST_SEED + chosen.seeds)
        for amplitude in chosen.amplitudes.split(",")
        for effect in chosen.effects.split(",")
    ]
    rows, _ = trials.rows_of(chosen, planned, trials.named(Trial), tried, line)
    if chosen.page:
        chosen.page.write_text(page(rows))


if __name__ == "__main__":
    main()
