"""The error on a second survey after the loop, beside a fit that was told the effect.

    python studies/verification.py --rows build/verification.jsonl --page docs/verification.md

The surveys are those of `loop_power.py`: half an hour at 2 Hz, four sensors with 0.15 nT of white noise and 1/f noise
of 0.02 nT/rtHz at 1 Hz, one effect of a given rms. The second survey has other motion, field and noise, the same
sensors and the same effect with the same coefficients; an effect of the site or of the reference, and a slip of a
recorder, stay with the first.
Judged are |b| - F and the tensor, which is zero in the uniform field of the second survey.

- **linear**: C and o alone; **loop**: `magtensor.close_loop` with the whole catalogue; **told**: the right effect with
  its true settings declared, and nothing searched.
- **above told**: how much larger the loop's error is than that of the fit that was told.

Who is told the waveform of a source that nobody logs is in `latent_study.py`. Rows that exist are not made again.
"""

from __future__ import annotations

import argparse
import copy
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import trials
from loop_power import NOISES, RIGHT
from loop_surveys import EFFECTS, model_of, recorded, scenario

import magtensor
from magtensor.errors import MagtensorError
from magtensor.simulate import simulate, write

NOISE = "white and 1/f"
FIGURES = {"field": "total_field_rms_nT", "tensor": "tensor_rms_nT_per_m"}
AT_REST: dict[str, dict[str, float]] = {  # where an effect is zero, or the second survey would have offsets of its own
    "temperature_offset": {"reference_degC": 20.0},
    "temperature_scale": {"reference_degC": 20.0},
    "supply_scale": {"reference_V": 12.0},
    "supply_offset": {"reference_V": 12.0},
}
WITHIN = 1.10  # of the error of the fit that was told


class Trial(NamedTuple):
    """A pair of surveys: effect, rms over white noise, motion, seed of the first."""

    effect: str
    amplitude: float
    motion: str
    seed: int


def written(trial: Trial, folder: Path) -> tuple[Path, Path]:
    """Both surveys as files."""
    model = model_of(trial.effect)
    first = scenario(trial.motion, NOISES[NOISE], trial.seed, trial.effect, trial.amplitude)
    first["effects"] = [effect | AT_REST.get(model, {}) for effect in first["effects"]]
    made = simulate(first)
    second = copy.deepcopy(scenario(trial.motion, NOISES[NOISE], trial.seed + 1))
    second["instrument"]["seed"] = first["instrument"]["seed"]
    second["effects"] = []
    for described, truth in zip(first["effects"], made.truth.effects, strict=True):
        if truth.kind != "instrument" or model == "lag_step":
            continue
        known = {key: value for key, value in described.items() if key not in ("rms_nT", "alike")}
        if model == "channel_response":  # its square is about the mean of the survey that it was found in
            known["reference"] = float(recorded(made).origins[known["channel"]])
        second["effects"].append(known | truth.coefficients)
    write(made, folder / "first.h5")
    write(simulate(second), folder / "second.h5")
    return folder / "first.h5", folder / "second.h5"


def tried(trial: Trial) -> dict[str, Any]:
    """The row of one trial."""
    row: dict[str, Any] = trial._asdict()
    model = model_of(trial.effect)
    told = dict(RIGHT.get(model, {}))
    with tempfile.TemporaryDirectory() as name:
        try:
            first, second = written(trial, Path(name))
            found = magtensor.close_loop(first, verify=second).verdict
            row["adopted"] = [one["error_model"] for one in found["adopted"]]
            row["unexplained"] = bool(found["unexplained"]["present"])
            for key, figure in FIGURES.items():
                before, after = (found["error"]["verify"][when][figure]["all"] for when in ("before", "after"))
                row[key] = {"linear": before, "loop": after}
            if model != "latent_source":
                best = magtensor.close_loop(first, verify=second, declared={model: told}, search=[]).verdict
                for key, figure in FIGURES.items():
                    row[key]["told"] = best["error"]["verify"]["after"][figure]["all"]
        except MagtensorError as error:
            return row | {"why": str(error).splitlines()[0]}
    return row


def above(row: dict[str, Any]) -> float | None:
    """The larger of both errors over that of the fit that was told; None where none was."""
    ratios = [row[key]["loop"] / row[key]["told"] for key in FIGURES if "told" in row.get(key, {})]
    return max(ratios) if len(ratios) == len(FIGURES) else None


def line(row: dict[str, Any]) -> str:
    """A row of the table."""
    head = f"| {row['effect']} | {row['amplitude']:g} x | {row['motion']} |"
    if "why" in row:
        return f"{head} cannot be: {row['why']} | | | |"
    adopted = ", ".join(row["adopted"]) or ("nothing; told" if row["unexplained"] else "nothing")
    cells = []
    for key in FIGURES:
        error = {which: f"{value:.3g}" for which, value in row[key].items()}
        cells.append(f"{error['linear']} -> {error['loop']} ({error.get('told', '-')})")
    ratio = above(row)
    return f"{head} {adopted} | {' | '.join(cells)} | {'-' if ratio is None else f'{100 * (ratio - 1):+.0f} %'} |"


def page(command: str, rows: list[dict[str, Any]], open_: int) -> str:
    """The study's page."""
    words = (__doc__ or "").split("\n\n", 2)[2].strip()
    ratios = [(row, ratio) for row in rows if (ratio := above(row)) is not None]
    within = sum(ratio <= WITHIN for _, ratio in ratios)
    named = [(row, ratio) for row, ratio in ratios if row["adopted"]]
    named_within = sum(ratio <= WITHIN for _, ratio in named)
    return "\n".join([
        "# The error on a second survey", "", words, "", f"`{command}`", "",
        *([f"Not complete: {open_} more trials of this command were not made.", ""] if open_ else []),
        f"Within 10 % of the fit that was told, in |b| - F and in the tensor: {within} of {len(ratios)} pairs of "
        f"surveys; of those where the loop adopted something, {named_within} of {len(named)}.", "",
        "| effect | rms | motion | adopted | total field, nT: linear -> loop (told) | tensor, nT/m | above told |",
        "|---|---|---|---|---|---|---|", *(line(row) for row in rows), "",
    ])  # fmt: skip


def planned(chosen: argparse.Namespace) -> Iterator[Trial]:
    """The trials that were asked for, in order."""
    for amplitude in chosen.amplitudes.split(","):
        for motion in chosen.motions.split(","):
            for effect in chosen.effects.split(","):
                yield Trial(effect, float(amplitude), motion, chosen.seed)


def main() -> None:
    """Run what is missing and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    trials.add_options(parser)
    parser.add_argument("--page", type=Path, help="write the table here")
    parser.add_argument("--effects", default=",".join(EFFECTS))
    parser.add_argument("--amplitudes", default="3", help="rms of the effect in units of the white noise")
    parser.add_argument("--motions", default="tumbling,tilt 40")
    parser.add_argument("--seed", type=int, default=5000)
    chosen = parser.parse_args()
    rows, open_ = trials.rows_of(chosen, planned(chosen), trials.named(Trial), tried, line)
    if chosen.page:
        command = f"python studies/verification.py {' '.join(repr(a) if ' ' in a else a for a in sys.argv[1:])}"
        chosen.page.write_text(page(command, rows, open_))


if __name__ == "__main__":
    main()
