"""How often the loop finds what is there, beside an oracle, and how often it accuses a clean survey.

    python studies/loop_power.py --rows build/loop_power.jsonl --page docs/loop_power.md --seconds 900

Each trial is a survey simulated in the time domain anew: four sensors with 0.15 nT of white noise each axis (and 1/f
noise of 0.02 nT/rtHz at 1 Hz), one effect of a given rms, half an hour of tumbling or of turning with tilts within 40
degrees, or 136 static postures. It goes through the whole search, with every error model.

- **right**: the effect, or a model declared indistinguishable from it, is all that was adopted; **more**: something
  else was adopted beside it; **wrong**: only something else was.
- **told**: nothing was adopted, but the verdict says that something unexplained is left; **missed**: it does not.
- **part**, where several effects were in the survey: some of them were adopted, and nothing else.

Most effects are there twice: with coefficients of each sensor's own, and (**alike**) with the same ones in all sensors.
Surveys with several effects have them from different families, so that none is another's rival, each of the rms given.

The **oracle** tests the right effect alone, once, with the right settings, in noise whose colour it knows from the same
survey without the effect, at the loop's level of one in 200. The loop has it harder: it tries some thirty models
with all their settings, and has to ask more of each of these tests to accuse one clean survey in 200 of anything. So
there is a second figure, **oracle that pays**: the same test at that level over the number of models times the
number of tests that the settings of the right one amount to. What is lost between the two is the price of not knowing
what to look for; no search with that false-alarm rate could have it. What the loop loses beside the second is its own:
the colour of the noise, which it does not know, and the held-out gain that it wants. The oracle of a source that nobody
logged would have to know the waveform; there is none. Intervals are exact ones of Clopper and Pearson, 95 %.

Surveys of one sample a second are quicker, but the turning with tilts is then too fast for the rates that the effects
of turning need: these are told as not tested.

Rows that exist are not made again: the command goes on where it stopped, and writes the page from all of them.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import loop_power_page
import numpy as np
import trials
from loop_surveys import BASE, EVERY_EFFECT, FAMILIES, MOTIONS, model_of, recorded, scenario

from magtensor.components import Component
from magtensor.errors import MagtensorError
from magtensor.loop.evidence.assessment import Colours, colours_of, estimated, explained
from magtensor.loop.fitting.model import Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.delayed_logs import Delays
from magtensor.loop.searching.found import Search
from magtensor.loop.searching.gates import ALPHA
from magtensor.loop.searching.outcome import why
from magtensor.loop.searching.profiling import SCREENING_SAMPLES, Thinned, best_settings
from magtensor.loop.searching.rounds import testable
from magtensor.loop.searching.search import search
from magtensor.loop.searching.unexplained import unexplained
from magtensor.registry import Registry
from magtensor.simulate import Simulated, simulate

NOISES = {"white": 0.0, "white and 1/f": 0.02}  # nT/rtHz at 1 Hz
FIRST_CLEAN, FIRST_SEED, FIRST_SEVERAL = 1000, 2000, 3000
RIGHT: dict[str, dict[str, Any]] = {
    "temperature_offset": {"channel": "temperature", "lag_s": 100.0},
    "temperature_scale": {"channel": "temperature"},
    "temperature_rate": {"channel": "temperature", "tau_s": 20.0},
    "warm_up": {"tau_s": 300.0},
    "current_field": {"channel": "current_heater"},
    "supply_scale": {"channel": "supply_voltage"},
    "supply_offset": {"channel": "supply_voltage"},
    "hysteresis": {"half_width_nT": 4000.0},
    "offset_step": {"time_s": 800.0},
    "offset_while": {"time_s": 600.0, "until_s": 1000.0},
    "scale_step": {"time_s": 1000.0},
    "turn_step": {"time_s": 1000.0},
    "calibration_step": {"time_s": 1000.0},
    "temperature_alignment": {"channel": "temperature"},
    "alignment_drift": {"tau_s": 600.0},
    "channel_alignment": {"channel": "pressure", "lag_s": 3.0},
    "sampling_lag": {"per_axis": True},
    "lag_step": {"time_s": 900.0},
    "viscous_magnetisation": {"tau_s": 20.0},
    "moving_part": {"channel": "encoder"},
    "periodic_interference": {"frequency_Hz": 49.7123},
    "channel_response": {"channel": "pressure", "power": 2, "lag_s": 3.0},
    "channel_rate": {"channel": "pressure", "lag_s": 20.0},
    "reference_step": {"time_s": 700.0},
    "reference_while": {"time_s": 600.0, "until_s": 1000.0},
    "reference_drift": {"order": 3},
    "passing_source": {"time_s": 900.0, "passage_s": 24.0},
}


class Trial(NamedTuple):
    """One survey: effect ("" for none), rms over white noise, motion, 1/f noise in nT/rtHz, seed, rate in Hz."""

    effect: str
    amplitude: float
    motion: str
    noise: str
    seed: int
    rate_Hz: float


@cache
def models() -> dict[str, Component]:
    """Every error model by name."""
    registry = Registry.load()
    return {name: registry.find("error_model", name) for name in registry.names("error_model")}


def simulated(trial: Trial) -> Simulated:
    """Its survey."""
    made = scenario(trial.motion, NOISES[trial.noise], trial.seed, trial.effect, trial.amplitude)
    return simulate(made | {"rate_Hz": trial.rate_Hz})


@cache
def colours_without(trial: Trial) -> Colours:
    """The colours of the noise of a clean survey."""
    return colours_of(joint_state(recorded(simulated(trial)), [], Fitting()).residual)


def delay_s(simulation: Simulated) -> float:
    """By how much the time stamps of the base station are late, s, where that is the effect."""
    return float(np.ravel(next(iter(simulation.truth.effects[0].coefficients.values())))[0])


def oracle(trial: Trial, simulation: Simulated, record: Record, state: State) -> float | None:
    """The p value of the effect alone with its right settings; None where these cannot be known."""
    from scipy.stats import chi2

    model = model_of(trial.effect)
    if model in ("", "latent_source") or "+" in model:
        return None
    settings = dict(RIGHT.get(model, {}))
    if model in ("offset_drift", "reference_drift", "scale_drift"):
        settings["span_s"] = float(np.ptp(record.time))
    if model == "reference_clock":
        settings["lag_s"] = delay_s(simulation)
    terms = models()[model].function(state.excitation, **settings).at(state.residual.samples)
    known = colours_without(trial._replace(effect="", amplitude=0.0))
    colours = known.among(state.residual)
    estimate = estimated(state.residual, terms, colours)
    return float(chi2.sf(explained(estimate), estimate.rank)) if estimate.rank else 1.0


def tests(trial: Trial, state: State) -> float:
    """How many tests the loop corrects the p value of the effect for: those of its settings, times the models tried."""
    every = testable(state.excitation, list(models().values()))
    few = Thinned.of(state, SCREENING_SAMPLES)
    delays = Delays(state.residual, state.excitation)
    found = best_settings(models()[model_of(trial.effect)], state, few, delays, {}, ALPHA / len(every))
    return len(every) * (found[0].tried if found else 1.0)


def lost(found: Search, effect: str) -> str:
    """Where the search lost an effect that it did not adopt."""
    words = []
    if effect in found.not_tested:
        return f"not tested: needs {' and '.join(found.not_tested[effect])}"
    if effect in found.failed:
        return f"its regressors cannot be made: {found.failed[effect]}"
    for number, step in enumerate(found.steps, 1):
        seen = next((c for c in step.candidates if c.model.name == effect), None)
        if effect in step.refused:
            words.append(f"round {number}, third gate: {step.refused[effect]}")
        elif effect in step.dropped:
            words.append(f"round {number}, after the refit: no longer significant")
        elif seen is not None:
            words.append(f"round {number}: {why(seen, step.adopted)}")
        else:
            words.append(f"round {number}, screening: not among the models looked at closely")
    return words[0] if words else "no round"


def judged(effect: str, found: Search, left: bool) -> str:
    """The outcome in one word, of effects joined by "+"."""
    adopted = {a.name for a in found.last.adopted}
    if not adopted:
        return "told" if left else "missed" if effect else "clean"
    named = [{s.adopted.model.name, *s.rivals} for s in found.steps if s.adopted and s.adopted.model.name in adopted]
    wanted = {model_of(one) for one in effect.split("+")} - {""}
    strange = not all(wanted & names for names in named)
    all_found = bool(wanted) and all(any(w in names for names in named) for w in wanted)
    if all_found:
        return "more" if strange or len(adopted) > len(wanted) else "right"
    return "wrong" if strange else "part"


def tried(trial: Trial) -> dict[str, Any]:
    """The row of one trial."""
    row: dict[str, Any] = trial._asdict()
    try:
        simulation = simulated(trial)
        record = recorded(simulation)
        if trial.effect == "reference_clock" and abs(delay_s(simulation)) > np.ptp(record.time):
            return row | {"outcome": "cannot be", "why": "the delay is longer than the survey and all its readings"}
        state = joint_state(record, [], Fitting())
        row["oracle"] = oracle(trial, simulation, record, state)
        if row["oracle"] is not None:
            row["tests"] = tests(trial, state)
        found = search(record, list(models().values()), Fitting())
    except MagtensorError as error:
        return row | {"outcome": "cannot be", "why": str(error).splitlines()[0]}
    left = unexplained(found, record)
    row["outcome"] = judged(trial.effect, found, left["present"])
    row["adopted"] = [a.name for a in found.last.adopted]
    row["rivals"] = sorted({r for s in found.steps for r in s.rivals})
    row["left"] = left["description"]
    if row["outcome"] != "right":
        missed = [e for e in map(model_of, trial.effect.split("+")) if e and e not in row["adopted"]]
        if missed:
            row["why"] = "; ".join(lost(found, e) for e in missed)
    return row


def planned(chosen: argparse.Namespace) -> Iterator[Trial]:
    """The trials that were asked for, in order."""
    motions = chosen.motions.split(",")
    for seed in range(FIRST_CLEAN, FIRST_CLEAN + chosen.clean):
        for noise in NOISES:
            for motion in motions:
                yield Trial("", 0.0, motion, noise, seed, chosen.rate)
    for seed in range(FIRST_SEED, FIRST_SEED + chosen.seeds):
        for noise in chosen.noises.split(","):
            for amplitude in chosen.amplitudes.split(","):
                for motion in motions:
                    for effect in chosen.effects.split(","):
                        yield Trial(effect, float(amplitude), motion, noise, seed, chosen.rate)
    for seed in range(FIRST_SEVERAL, FIRST_SEVERAL + chosen.several):
        rng = np.random.default_rng(seed)
        for count in (2, 3):
            families = rng.choice(len(FAMILIES), count, replace=False)
            effects = "+".join(str(rng.choice(FAMILIES[i])) for i in families)
            yield Trial(effects, 1.0, "tumbling", "white and 1/f", seed, chosen.rate)


def main() -> None:
    """Run what is missing and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    trials.add_options(parser)
    parser.add_argument("--page", type=Path, help="write the tables here")
    parser.add_argument("--clean", type=int, default=10, help="clean surveys of each motion and noise")
    parser.add_argument("--seeds", type=int, default=1, help="surveys of each effect, amplitude, motion and noise")
    parser.add_argument("--several", type=int, default=10, help="tumbling surveys with two and with three effects, 1 x")
    parser.add_argument("--effects", default=",".join(EVERY_EFFECT))
    parser.add_argument("--amplitudes", default="1,3,0.3", help="rms of the effect in units of the white noise")
    parser.add_argument("--motions", default=",".join(MOTIONS))
    parser.add_argument("--noises", default="white and 1/f", help=f"of the surveys with effects: {', '.join(NOISES)}")
    parser.add_argument("--rate", type=float, default=BASE["rate_Hz"], help="Hz")
    chosen = parser.parse_args()
    rows, open_ = trials.rows_of(chosen, planned(chosen), trials.named(Trial), tried, loop_power_page.line)
    if chosen.page:
        command = f"python studies/loop_power.py {' '.join(repr(a) if ' ' in a else a for a in sys.argv[1:])}"
        chosen.page.write_text(loop_power_page.page(__doc__ or "", command, rows, open_))


if __name__ == "__main__":
    main()
