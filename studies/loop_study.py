"""How often the loop accuses a clean survey, and how often it finds what is there.

    python studies/loop_study.py --clean 20 --amplitudes 0.3,1 --seeds 1 --output docs/loop_study.md

Every survey is simulated in the time domain anew (half an hour at 2 Hz, four sensors, 0.15 nT white noise), run
through the stages of recipes/closed_loop.yaml up to the search, and judged: *right* when the effect or a declared rival
of it is all that was adopted, *more* when something else was adopted beside it, *told* when nothing was adopted but
the verdict says that something unexplained is left, *missed* when it says that nothing is, *wrong* otherwise.
"""

from __future__ import annotations

import argparse
import copy
import os
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from magtensor.errors import MagtensorError
from magtensor.loop.model import Fitting
from magtensor.loop.record import record_of
from magtensor.loop.search import search
from magtensor.loop.unexplained import unexplained
from magtensor.recipe.plan import plan
from magtensor.recipe.source import parse_yaml
from magtensor.registry import Registry
from magtensor.runner import run
from magtensor.session import empty_survey
from magtensor.simulate import simulate, write

BASE: dict[str, Any] = {
    "title": "study",
    "seed": 1,
    "start": "2026-03-21T09:00:00Z",
    "rate_Hz": 2.0,
    "instrument": {
        "seed": 41,
        "array": {"shape": "cross", "baseline_m": 0.5},
        "errors": {"scale": 0.01, "non_orthogonality_deg": 0.5, "misalignment_deg": 1.0, "bias_nT": 100.0},
        "noise": {"white_sd_nT": 0.15},
    },
    "field": {
        "earth": {"total_field_nT": 49500.0, "inclination_deg": 66.0, "declination_deg": 4.0},
        "variation": {"diurnal": {"amplitude_nT": [5.0, -20.0, 8.0]}, "irregular": {"rms_nT": 1.5, "time_s": 400.0}},
    },
    "base_station": {"rate_Hz": 0.5, "noise_sd_nT": 0.1, "resolution_nT": 0.01},
    "channels": {
        "temperature": {
            "type": "temperature", "ambient_degC": 18.0, "trend_degC_per_h": 5.0, "wander_rms_degC": 1.0,
            "wander_time_s": 400.0, "self_heating_degC": 4.0, "tau_s": 240.0, "log_noise": 0.02,
        },
        "current_heater": {"type": "switched", "levels": [0.0, 1.5], "mean_hold_s": 45.0, "log_noise": 0.005},
        "supply_voltage": {
            "type": "supply", "resistance_ohm": 0.2, "loads": ["current_heater"], "wander_rms_V": 0.1,
            "log_noise": 0.001,
        },
        "encoder": {"type": "angle", "log_noise": 0.001},
        "pressure": {"type": "smooth", "mean": 5.0, "rms": 1.0, "time_s": 100.0, "units": "hPa", "log_noise": 0.002},
    },
    "logging": {"attitude": True, "acceleration": True},
}  # fmt: skip
MOTIONS: dict[str, dict[str, Any]] = {
    "tumbling": {"type": "tumbling", "duration_s": 1800.0, "rate_rms_deg_s": 20.0, "rate_time_s": 4.0},
    "tilt 40": {"type": "limited_tilt", "duration_s": 1800.0, "tilt_deg": 40.0},
    "postures": {"type": "postures", "random_count": 136, "rest_s": 10.0, "turn_s": 3.0, "average": True},
}
EFFECTS: dict[str, dict[str, Any]] = {
    "temperature_offset": {"lag_s": 100.0},
    "temperature_scale": {},
    "temperature_rate": {},
    "offset_drift": {},
    "scale_drift": {},
    "warm_up": {"tau_s": 300.0},
    "current_field": {"channel": "current_heater"},
    "supply_scale": {},
    "supply_offset": {},
    "nonlinearity_quadratic": {},
    "nonlinearity_cubic": {},
    "cross_field": {},
    "hysteresis": {"half_width_nT": [4000.0]},
    "offset_step": {"time_s": [800.0]},
    "sampling_lag": {"per_axis": True},
    "eddy_current": {},
    "bandwidth": {},
    "clock_drift": {},
    "viscous_magnetisation": {},
    "moving_part": {"position_m": [0.3, 0.2, -0.8]},
    "periodic_interference": {"frequency_Hz": 49.7},
    "frame_flexure": {},
    "channel_response": {"channel": "pressure", "power": 2, "lag_s": 3.0},
    "latent_source": {"waveform_of": {"type": "switched", "mean_hold_s": 70.0}},
    "fixed_source": {"position_m": [4.0, 0.0, -1.0]},
    "site_gradient": {},
    "reference_scale": {},
    "reference_clock": {},
    "reference_step": {"time_s": [700.0]},
}
STAGES = "title: study\nstages: [load, {detrend_diurnal: {uncovered: mask}}]\n"


def judged(scenario: dict[str, Any], truth: str, models: list[Any]) -> tuple[str, str]:
    """The outcome's class and what was adopted."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "survey.h5"
        write(simulate(scenario), path)
        planned = plan(parse_yaml(STAGES, "study"), survey=path)
        record = record_of(run(planned, empty_survey(planned)).survey)
    found = search(record, models, Fitting())
    adopted = [a.name for a in found.last.adopted]
    rivals = {r for s in found.steps for r in s.rivals}
    left = unexplained(found, record)["present"]
    words = ", ".join(adopted) + (f" (rivals {', '.join(sorted(rivals))})" if rivals else "")
    if not truth:
        return ("wrong" if adopted else "told" if left else "right"), words
    if truth in adopted or (adopted and truth in rivals):
        return ("right" if len(set(adopted)) == 1 else "more"), words
    if adopted:
        return ("wrong, and told" if left else "wrong"), words
    return ("told" if left else "missed"), words


def main() -> None:
    """Run the study and write its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clean", type=int, default=20, help="clean surveys of each kind of motion and noise")
    parser.add_argument("--amplitudes", default="0.3,1", help="rms of the effect in units of the white noise")
    parser.add_argument("--seeds", type=int, default=1, help="surveys of each effect, motion and amplitude")
    parser.add_argument("--motions", default=",".join(MOTIONS), help="which motions")
    parser.add_argument("--effects", default=",".join(EFFECTS), help="which effects")
    parser.add_argument("--output", type=Path, help="write the table here as well")
    chosen = parser.parse_args()
    registry = Registry.load()
    models = [registry.find("error_model", n) for n in registry.names("error_model")]
    lines = [
        f"`python studies/loop_study.py {' '.join(sys.argv[1:])}`",
        "",
        "| what | motion | noise | result |",
        "|---|---|---|---|",
    ]

    def tell(line: str) -> None:
        lines.append(line)
        print(line, flush=True)
        if chosen.output:
            chosen.output.write_text(
                "# The loop on simulated surveys\n\n"
                + (__doc__ or "").split("\n\n", 2)[2]
                + "\n"
                + "\n".join(lines)
                + "\n"
            )

    for motion in chosen.motions.split(","):
        for flicker in (0.0, 0.02):
            outcomes: Counter[str] = Counter()
            accused: list[str] = []
            for seed in range(chosen.clean):
                scenario = copy.deepcopy(BASE) | {"motion": MOTIONS[motion], "seed": 1000 + seed}
                scenario["instrument"]["noise"]["flicker_nT_per_rtHz"] = flicker
                try:
                    outcome, words = judged(scenario, "", models)
                except MagtensorError as error:
                    outcome, words = "refused", str(error).splitlines()[0]
                outcomes[outcome] += 1
                if outcome != "right":
                    accused.append(words)
            told = ", ".join(f"{k} {v}" for k, v in outcomes.items()) + (f": {'; '.join(accused)}" if accused else "")
            tell(f"| clean, {chosen.clean} surveys | {motion} | white{' and 1/f' if flicker else ''} | {told} |")
    noise = BASE["instrument"]["noise"]["white_sd_nT"]
    for name in chosen.effects.split(","):
        for motion in chosen.motions.split(","):
            for amplitude in [float(a) for a in chosen.amplitudes.split(",")]:
                results = []
                for seed in range(chosen.seeds):
                    scenario = copy.deepcopy(BASE) | {"motion": MOTIONS[motion], "seed": 2000 + seed}
                    scenario["instrument"]["noise"]["flicker_nT_per_rtHz"] = 0.01
                    scenario["effects"] = [{"type": name, "rms_nT": amplitude * noise} | EFFECTS[name]]
                    try:
                        outcome, words = judged(scenario, name, models)
                    except MagtensorError as error:
                        outcome, words = "cannot be", str(error).splitlines()[0]
                    results.append(outcome if outcome in ("right", "missed") else f"{outcome}: {words}")
                told = ", ".join(f"{k}" if v == 1 else f"{v} x {k}" for k, v in Counter(results).items())
                tell(f"| {name}, {amplitude:g} x noise | {motion} | white and 1/f | {told} |")


if __name__ == "__main__":
    main()
