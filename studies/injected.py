"""An effect put into a measured recording: does the loop find it beside what is there already?

    python studies/injected.py --rows build/injected.jsonl --page docs/measured/injected.md

Each trial is a part of a recording, loaded as its recipe says, into whose outputs an effect is put here, as it would
have come about: a body that follows a thermometer through a heat capacity, a jump, a magnet that lies beside a sensor
for a while, a current that is switched and logged, the same that nobody logs, samples that come late, a curve of the
sensor. Its size is a multiple of the noise floor that the loop finds without it, rms over the part and the axes that it
acts on. The stages are those of `recipes/closed_loop.yaml`. What is adopted of the part as it was measured is no claim
of this study; it is compared with that:

- **right**: the effect is adopted, on the right sensors, under its name or as a response to its channel; **rival**: it
  is named as indistinguishable from what is adopted; **wrong**: something else is adopted in its place; **told**:
  nothing is, but what is left looks like it, or is more than without it; **missed**: none of these; **refused**: the
  part with the effect in it has no calibration, and the run says why.
- **beside it**: adopted, though neither put in nor adopted without it.
- **off by**: the coefficients against those put in, as a share of these, where it is adopted under its own name.

The recordings are not part of the project (docs/measured/README.md). No number of the loop was set on these trials.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import trials
import yaml
from windows import HOUR_S, Part, recipe_of

from magtensor.errors import MagtensorError
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import Plan, read_plan
from magtensor.runner import run
from magtensor.survey.model import Survey

Array = np.ndarray[Any, Any]

BALLOON, QUADCOPTER = Part("loop_balloon", 3300, 4600), Part("loop_quadcopter", 0, 145)
CONRAD = Part("conrad", 8 * HOUR_S, 10 * HOUR_S)
EFFECTS = {
    BALLOON: (
        "temperature_offset", "offset_step", "current_field", "latent_source", "sampling_lag", "nonlinearity_cubic",
    ),
    QUADCOPTER: ("temperature_offset", "offset_step", "offset_while", "current_field", "latent_source"),
    CONRAD: ("offset_step", "offset_while", "current_field", "latent_source"),
}  # fmt: skip
AMPLITUDES = (3.0, 10.0)
LATE_S, LOADED_A, HOLD_S = 60.0, 1.5, 40.0
FULL_SCALE_NT = 50_000.0
HALF = 0.5  # of coefficients, by which they may be off where the recording has some of that name itself
MORE = 1.1  # times what is left without the effect
SEED = 20
OUTCOMES = ("right", "rival", "wrong", "told", "missed")


class Trial(NamedTuple):
    """A part, the effect that is put in ("" for none) and its size over the noise floor."""

    part: Part
    effect: str = ""
    amplitude: float = 0.0


class Put(NamedTuple):
    """An effect in outputs: (N, S, 3) nT, the numbers of the sensors it acts on, the vector or coefficients put in (of
    the first of them), and channels that log it."""

    added: Array
    sensors: tuple[int, ...]
    coefficients: Array
    channels: dict[str, tuple[Array, str]]


def planned_trials() -> list[Trial]:
    """All of them, each part without an effect first."""
    return [
        trial
        for part, effects in EFFECTS.items()
        for trial in (Trial(part), *(Trial(part, effect, size) for effect in effects for size in AMPLITUDES))
    ]


@cache
def prepared(part: Part) -> tuple[Plan, Survey]:
    """The stages that are left, and the survey before `close_loop`."""
    with tempfile.TemporaryDirectory() as folder:
        recipe = Path(folder) / "part.yaml"
        recipe.write_text(yaml.safe_dump(recipe_of(part), sort_keys=False), encoding="utf-8")
        planned = read_plan(recipe)
    first = next(i for i, stage in enumerate(planned.stages) if stage.name == "close_loop")
    survey = run(replace(planned, stages=planned.stages[:first]), empty_survey(planned)).survey
    return replace(planned, stages=planned.stages[first:]), survey


def followed(time: Array, course: Array, time_constant: float) -> Array:
    """(N,) what a body of a heat capacity has of a course (N,), by the explicit solution from sample to sample."""
    out = np.empty_like(course)
    out[0] = course[0]
    for i, step in enumerate(np.diff(time)):
        out[i + 1] = course[i + 1] + (out[i] - course[i + 1]) * np.exp(-step / time_constant)
    return out


def switched(time: Array, rng: np.random.Generator) -> Array:
    """(N,) A, on and off for some while each."""
    edges = time[0] + np.cumsum(rng.exponential(HOLD_S, size=int(np.ptp(time) / HOLD_S * 3) + 10))
    return LOADED_A * (np.searchsorted(edges, time) % 2)


def put_into(survey: Survey, effect: str, rms: float) -> Put:
    """An effect of an rms (nT) over the samples in use and the axes of its sensors."""
    time, raw = np.asarray(survey.time, dtype=float), np.asarray(survey.values("b_raw"), dtype=float)
    rng = np.random.default_rng(SEED)
    elapsed = (time - time[0]) / np.ptp(time)
    sensors = raw.shape[1]
    one = rng.standard_normal((sensors, 3))
    channels: dict[str, tuple[Array, str]] = {}
    acting: tuple[int, ...] = (0,)
    course: Array | None = None
    if effect == "temperature_offset":
        temperature = np.asarray(survey.values("temperature"), dtype=float).reshape(len(time), -1)[:, 0]
        course = followed(time, temperature, LATE_S)
    elif effect == "offset_step":
        course = (elapsed > 0.6).astype(float)
    elif effect == "offset_while":
        course = ((elapsed > 0.4) & (elapsed < 0.7)).astype(float)
    elif effect in ("current_field", "latent_source"):
        course = switched(time, rng)
        acting = (0,) if effect == "current_field" else tuple(range(sensors))
        if effect == "current_field":
            channels = {"current_heater": (course + 0.005 * rng.standard_normal(len(time)), "A")}
    use = survey.good & np.isfinite(raw).all(axis=(1, 2))
    mine = np.isin(np.arange(sensors), acting)
    if course is not None:
        added = (course - course[use].mean())[:, None, None] * one * mine[:, None]
        if effect.startswith("offset"):
            added = course[:, None, None] * one * mine[:, None]
    elif effect == "sampling_lag":
        added = np.zeros_like(raw)
        for axis in range(3):
            rate = np.gradient(np.interp(time, time[use], raw[use, 0, axis]), time)
            added[:, 0, axis] = -rate
    else:
        added = (raw / FULL_SCALE_NT) ** 3 * one * mine[:, None]
    within = added[use][:, mine] - added[use][:, mine].mean(axis=0)
    size = rms / float(np.sqrt(np.mean(within**2)))
    if effect == "sampling_lag":  # by as much as the rate of change says, read between the samples
        late = np.stack([np.interp(time - size, time[use], raw[use, 0, axis]) for axis in range(3)], axis=1)
        added = np.zeros_like(raw)
        added[:, 0] = late - raw[:, 0]
        return Put(added, acting, np.array([size]), channels)
    return Put(size * added, acting, size * one[acting[0]], channels)


def loop_on(part: Part, put: Put | None) -> dict[str, Any]:
    """The verdict on a part with an effect in it."""
    planned, survey = prepared(part)
    if put is not None:
        raw = survey["b_raw"]
        changed: dict[str, Any] = {"b_raw": (tuple(raw.dims), raw.values + put.added, dict(raw.attrs))}
        for name, (values, units) in put.channels.items():
            changed[name] = (("time",), values, {"units": units})
        survey = survey.merged(changed)
    found = run(planned, survey).survey
    told: dict[str, Any] = json.loads(str(found["loop/verdict"].values))
    return told


@cache
def alone(part: Part) -> dict[str, Any]:
    """The verdict on a part as it was measured."""
    return loop_on(part, None)


def tried(trial: Trial) -> dict[str, Any]:
    """The row of a trial."""
    part = Part(*trial.part)
    row: dict[str, Any] = {"part": list(part), "effect": trial.effect, "amplitude": trial.amplitude}
    try:
        before = alone(part)
        row |= {"floor": before["noise_floor_nT"]}
        if not trial.effect:
            return row | facts(before)
        survey = prepared(part)[1]
        put = put_into(survey, trial.effect, trial.amplitude * before["noise_floor_nT"])
        now = loop_on(part, put)
    except MagtensorError as error:
        return row | {"refused": str(error).splitlines()[0]}
    names = [survey.sensors[s] for s in put.sensors]
    return row | facts(now) | judged(trial.effect, names, put, before, now)


def facts(told: dict[str, Any]) -> dict[str, Any]:
    """What the table shows of a verdict."""
    errors = {k: ((told["held_out"][k] or {}).get("total_field_rms_nT") or {}).get("all") for k in ("before", "after")}
    return {"adopted": [a["error_model"] for a in told["adopted"]], "errors": errors, "left": left(told)}


def left(told: dict[str, Any]) -> float:
    """nT that the verdict says are unexplained."""
    return float(told["unexplained"]["excess_rms_nT"]) if told["unexplained"]["present"] else 0.0


def judged(effect: str, names: list[str], put: Put, before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """The outcome in a word, what was adopted beside it, and how far off the coefficients are."""
    known = {a["error_model"] for a in before["adopted"]}
    acts = [a for a in now["adopted"] if of_the_effect(a, effect, put) and set(names) <= set(a["sensors"] or names)]
    own = next((a for a in acts if a["error_model"] == effect), None)
    off = None if own is None else off_by(own, names[0], put)
    if own is not None and effect in known and off is not None and not off < HALF:
        acts = []  # that of the recording itself
    others = [a["error_model"] for a in now["adopted"] if a not in acts and a["error_model"] not in known]
    if any(a["error_model"] in (effect, "channel_response") for a in acts):
        outcome = "right"
    elif acts:
        outcome = "rival"
    elif others:
        outcome = "wrong"
    elif effect in (now["unexplained"].get("looks_like") or []) or left(now) > MORE * left(before):
        outcome = "told"
    else:
        outcome = "missed"
    return {"outcome": outcome, "beside": others, "off": off if acts else None}


def of_the_effect(adopted: dict[str, Any], effect: str, put: Put) -> bool:
    """Whether an adopted model is the effect or names it: of a channel that was put in, that channel's."""
    channel = str(adopted["settings"].get("channel", ""))
    if put.channels and channel:
        return channel in put.channels
    if put.channels:
        return False
    return adopted["error_model"] == effect or effect in adopted["indistinguishable_from"]


def off_by(adopted: dict[str, Any], sensor: str, put: Put) -> float:
    """How far the coefficients of the first sensor are from those put in, as a share of these."""
    found = [c["value"] for c in adopted["coefficients"] if c["sensor"] == sensor][: len(put.coefficients)]
    if len(found) < len(put.coefficients) or adopted["error_model"] == "latent_source":
        return float("nan")
    return float(np.linalg.norm(np.array(found) - put.coefficients) / np.linalg.norm(put.coefficients))


def words(row: dict[str, Any]) -> list[str]:
    """The cells of a row of the table."""
    part = Part(*row["part"])
    unit, length = ("h", HOUR_S) if part.recipe == "conrad" else ("s", 1)
    name = f"{part.recipe.removeprefix('loop_')} {part.begin / length:g} to {part.end / length:g} {unit}"
    what = f"`{row['effect']}`, {row['amplitude']:g} x {row['floor']:.3g} nT" if row["effect"] else "as measured"
    if "refused" in row:
        return [name, what, "refused", "", "", "", ""]
    adopted = ", ".join(f"`{a}`" for a in row["adopted"]) or "nothing"
    errors = " -> ".join("-" if row["errors"][k] is None else f"{row['errors'][k]:.3g}" for k in ("before", "after"))
    off = row.get("off")
    share = "" if off is None or not np.isfinite(off) else f"{100 * off:.0f} %"
    beside = ", ".join(f"`{a}`" for a in row.get("beside", []))
    return [name, what, row.get("outcome", ""), adopted, beside, share, errors]


def table(rows: list[dict[str, Any]]) -> str:
    """All rows."""
    head = ["part", "put in", "outcome", "adopted", "beside it", "off by", "held-out rms of b - F, nT"]
    lines = [head, ["---"] * len(head), *(words(row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def totals(rows: list[dict[str, Any]]) -> str:
    """How often each outcome came, amplitude by amplitude."""
    made = [r for r in rows if r["effect"]]
    head = ["size over the noise floor", "trials", *OUTCOMES, "refused", "something else beside it"]
    lines = [head, ["---"] * len(head)]
    for size in sorted({r["amplitude"] for r in made}):
        mine = [r for r in made if r["amplitude"] == size]
        counts: list[Callable[[dict[str, Any]], bool]] = [
            *(lambda r, w=word: r.get("outcome") == w for word in OUTCOMES),
            lambda r: "refused" in r,
            lambda r: bool(r.get("beside")),
        ]
        lines.append([f"{size:g} x", str(len(mine)), *(str(sum(map(c, mine))) for c in counts)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def tables(rows: list[dict[str, Any]]) -> str:
    """What the page says of the rows that there are."""
    done = f"{sum(bool(r['effect']) for r in rows)} of {sum(bool(t.effect) for t in planned_trials())} trials so far."
    return f"{done}\n\n{totals(rows)}\n\n{table(rows)}"


def trial_of(row: dict[str, Any]) -> Trial:
    """The trial that a row is of."""
    return Trial(Part(*row["part"]), row["effect"], row["amplitude"])


def main() -> None:
    def planned(only: str) -> list[Trial]:
        return [trial for trial in planned_trials() if only in trial.part.recipe]

    title = "An effect put into measured recordings"
    trials.of_recordings(title, __doc__, planned, trial_of, tried, words, tables)


if __name__ == "__main__":
    main()
