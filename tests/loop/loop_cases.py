"""Surveys of the simulator for the loop, and the loop run on them as a user runs it."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.error_models.settings import EventTimes, profiled
from magtensor.loop.evidence.assessment import assess
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.evidence.spectrum import spectral_lines
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.record import record_of
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.gates import Candidate
from magtensor.preparing import empty_survey, load_as
from magtensor.recipe.plan import read_plan
from magtensor.registry import Registry
from magtensor.runner import run
from magtensor.simulate import simulate, write
from magtensor.verdict import verdict

Array = NDArray[np.float64]

RECIPE = Path(__file__).parents[2] / "recipes" / "closed_loop.yaml"

BASE: dict[str, Any] = {
    "title": "test of the loop",
    "seed": 1,
    "rate_Hz": 2.0,
    "instrument": {
        "seed": 7,
        "array": {"shape": "cross", "baseline_m": 0.5},
        "errors": {"scale": 0.01, "non_orthogonality_deg": 0.5, "misalignment_deg": 1.0, "bias_nT": 100.0},
        "noise": {"white_sd_nT": 0.15, "flicker_nT_per_rtHz": 0.01},
    },
    "motion": {"type": "tumbling", "duration_s": 1200.0, "rate_rms_deg_s": 15.0, "rate_time_s": 5.0},
    "field": {
        "earth": {"total_field_nT": 49500.0, "inclination_deg": 66.0, "declination_deg": 4.0},
        "variation": {
            "pulsations": [{"rms_nT": 2.0, "period_s": 60.0}],
            "irregular": {"rms_nT": 10.0, "time_s": 300.0},
        },
    },
    "base_station": {"rate_Hz": 0.5, "noise_sd_nT": 0.1, "resolution_nT": 0.01},
    "channels": {
        "temperature": {
            "type": "temperature",
            "trend_degC_per_h": 5.0,
            "wander_rms_degC": 1.0,
            "wander_time_s": 300.0,
            "self_heating_degC": 4.0,
            "tau_s": 240.0,
            "log_noise": 0.02,
        },
        "current_heater": {"type": "switched", "levels": [0.0, 1.5], "mean_hold_s": 45.0, "log_noise": 0.005},
    },
    "truth": "effects",
}


def scenario(seed: int = 1, *effects: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """The survey of that seed, some sections replaced, with effects."""
    return copy.deepcopy(BASE) | {"seed": seed, "effects": list(effects)} | changes


def survey_file(folder: Path, description: dict[str, Any], name: str = "survey.h5") -> Path:
    """The survey written as a user has it."""
    path = folder / name
    write(simulate(description), path)
    return path


def lasting_effects() -> list[str]:
    """The catalogue without single events, whose times make most of its settings."""
    registry = Registry.load()
    models = [registry.find("error_model", name) for name in registry.names("error_model")]
    return [m.name for m in models if not any(isinstance(g, EventTimes) for g in profiled(m).values())]


def verdict_of(
    folder: Path,
    description: dict[str, Any],
    change: Callable[[Path], None] | None = None,
    models: Sequence[str] | None = None,
) -> dict[str, Any]:
    """What `magtensor run recipes/closed_loop.yaml` would say of a survey; `change` may spoil its file before.

    With `models` the loop looks for these only.
    """
    path = survey_file(folder, description)
    if change is not None:
        change(path)
    only = [] if models is None else [f"stages.close_loop.search=[{', '.join(models)}]"]
    planned = read_plan(RECIPE, survey=path, overrides=only)
    found: dict[str, Any] = json.loads(json.dumps(verdict(run(planned, empty_survey(planned)).survey)))
    return found


def adopted_names(verdict: dict[str, Any]) -> set[str]:
    """Names of what was adopted."""
    return {a["error_model"] for a in verdict["adopted"]}


def suspects(verdict: dict[str, Any]) -> set[str]:
    """Names of what was adopted, and of what the survey does not tell from it."""
    return adopted_names(verdict) | {n for a in verdict["adopted"] for n in a["indistinguishable_from"]}


def loaded(folder: Path, description: dict[str, Any], change: Callable[[Path], None] | None = None) -> Record:
    """The record of a survey as the loop sees it; `change` may spoil its file before."""
    path = survey_file(folder, description)
    if change is not None:
        change(path)
    return record_of(load_as(read_plan(RECIPE, survey=path), path))


def linear_state(record: Record) -> State:
    """The joint fit with the linear model alone."""
    return joint_state(record, [], Fitting())


def lines_left(record: Record) -> list[tuple[float, float, float]]:
    """The strongest lines of what the linear model leaves."""
    residual = linear_state(record).residual
    return spectral_lines(residual, record.time[residual.samples])


def synthetic(
    seed: int,
    samples: int = 1200,
    sensors: int = 4,
    noise_nT: float = 1.0,
    added: Array | None = None,
    turning_s: float = 0.0,
) -> Record:
    """A record drawn here, one sample a second: random attitudes, white noise and `added` (N, S, 3) nT.

    With `turning_s` the direction of the field changes slowly, within about so many seconds.
    """
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((samples, 3))
    if turning_s:
        within = np.arange(-4 * turning_s, 4 * turning_s + 1)
        bell = np.exp(-0.5 * (within / turning_s) ** 2)
        u = np.column_stack([np.convolve(rng.standard_normal(samples), bell, mode="same") for _ in range(3)])
    total = 50_000.0 + 10.0 * np.sin(np.arange(samples) / 90.0)
    field = u / np.linalg.norm(u, axis=1, keepdims=True) * total[:, None]
    forward = np.eye(3) + 0.01 * rng.standard_normal((sensors, 3, 3))
    raw = np.einsum("sij,nj->nsi", forward, field) + 100.0 * rng.standard_normal((sensors, 3))
    raw = raw + noise_nT * rng.standard_normal(raw.shape) + (0.0 if added is None else added)
    time = np.arange(samples, dtype=float)
    return Record(
        time=time,
        start=0.0,
        raw=raw,
        total_field=total,
        quiet_field=total,
        sensors=tuple(f"S{i + 1}" for i in range(sensors)),
        logged={},
        origins={},
        units={},
        run=np.zeros(samples, dtype=int),
        segment=np.zeros(samples, dtype=int),
        position=None,
        attitude=None,
        samples=np.arange(samples),
    )


def flicker(rng: np.random.Generator, shape: tuple[int, ...], crossing: float = 0.02) -> Array:
    """White noise of unit variance plus 1/f noise as strong at the frequency `crossing` (cycles a sample)."""
    n = shape[0]
    f = np.fft.rfftfreq(2 * n)
    f[0] = f[1]
    spectrum = np.fft.rfft(rng.standard_normal((2 * n, *shape[1:])), axis=0)
    slow = np.fft.irfft(spectrum * np.sqrt(crossing / f).reshape(-1, *[1] * (len(shape) - 1)), axis=0)[:n]
    return slow + rng.standard_normal(shape)


def looked_at(state: State, model: Adopted, *, once: bool = False) -> Candidate:
    """A model as a candidate, its settings given; `once` if it is of something that happens once."""
    terms = model.terms(state.excitation).at(state.residual.samples)
    white = Whitened.of(state.residual, state.colours.across, state.colours.along, state.terms)
    found = assess(white, terms, once=once)
    return Candidate(model, 1.0, terms, found, found.p, found.own_p, found.null_p)
