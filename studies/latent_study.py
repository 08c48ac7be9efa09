"""A source that nobody logged: false alarms, how often it is found, and the error on a second survey.

    python studies/latent_study.py --clean 20 --verify --output docs/latent_study.md

Half an hour at 2 Hz (or 136 postures) with 0.15 nT white noise and 1/f noise of 0.01 nT at 1 Hz. *Clean*: surveys
without a source in which the test of common factors is significant at one in a thousand, and those in which one is
adopted. *Instead of another effect*: the same of surveys with an effect of attitude that the search does not know.
*Verification*: total field and tensor rms on a second survey with the source, with the linear model, with what the loop
found, and with a fit that was told the waveform as a channel.
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import yaml
from loop_surveys import BASE, EFFECTS, MOTIONS, STAGES

from magtensor.errors import MagtensorError
from magtensor.loop.fitting.model import Fitting, Record
from magtensor.loop.fitting.record import record_of
from magtensor.loop.searching.found import Search
from magtensor.loop.searching.search import search
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import plan
from magtensor.recipe.source import parse_yaml
from magtensor.registry import Registry
from magtensor.runner import run
from magtensor.session import run_recipe
from magtensor.simulate import simulate, write

RECIPE = Path(__file__).parents[1] / "recipes" / "closed_loop.yaml"
NOISE_NT = 0.15
ARRAYS: dict[int, dict[str, Any]] = {
    2: {"positions_m": [[0.25, 0.0, 0.0], [-0.25, 0.0, 0.0]]},
    3: {"shape": "triangle", "baseline_m": 0.5},
    4: {"shape": "cross", "baseline_m": 0.5},
}
SOURCES: dict[str, dict[str, Any]] = {
    "switching": {"type": "switched", "levels": [-1.0, 1.0], "mean_hold_s": 70.0},
    "smooth": {"type": "smooth", "rms": 1.0, "time_s": 60.0},
    "broadband": {"type": "smooth", "rms": 1.0, "time_s": 0.2},
}
TURNING = (
    "frame_flexure", "sampling_lag", "eddy_current", "nonlinearity_quadratic", "nonlinearity_cubic", "cross_field",
    "hysteresis", "temperature_scale", "scale_drift", "site_gradient", "fixed_source", "viscous_magnetisation",
    "clock_drift", "bandwidth", "supply_scale",
)  # fmt: skip


def scenario(seed: int, sensors: int, motion: str, flicker: float, *effects: dict[str, Any]) -> dict[str, Any]:
    """A survey of the study."""
    made = copy.deepcopy(BASE) | {"motion": MOTIONS[motion], "seed": seed, "effects": list(effects)}
    made["instrument"]["noise"]["flicker_nT_per_rtHz"] = flicker
    made["instrument"]["array"] = ARRAYS[sensors]
    return made


def recorded(description: dict[str, Any]) -> Record:
    """Its samples as the loop sees them."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "survey.h5"
        write(simulate(description), path)
        planned = plan(parse_yaml(STAGES, "study"), survey=path)
        return record_of(run(planned, empty_survey(planned)).survey)


def alone(description: dict[str, Any]) -> Search:
    """The search with no other model to adopt than this one."""
    return search(recorded(description), [Registry.load().find("error_model", "latent_source")], Fitting())


def counted(surveys: list[dict[str, Any]]) -> str:
    """How many of the surveys are significant, and in how many the source is adopted."""
    significant = adopted = refused = 0
    for description in surveys:
        try:
            found = alone(description)
        except MagtensorError:
            refused += 1
            continue
        adopted += len(found.last.adopted)
        significant += bool(found.last.adopted) or (found.shared is not None and found.shared.significant)
    kept = len(surveys) - refused
    return f"{kept} | {significant} | {adopted}"


def vectors(sensors: int, amplitude: float) -> list[list[float]]:
    """(S, 3) nT, drawn once."""
    drawn = np.random.default_rng(3).standard_normal((sensors, 3))
    return [[float(v) for v in row] for row in amplitude * NOISE_NT * drawn]


def verified(sensors: int, motion: str, source: str, amplitude: float) -> str:
    """The errors on a second survey as a row of the table."""
    own = {"nT_per_unit": vectors(sensors, amplitude)}
    told = {"type": "channel_response", "channel": "hidden", "reference": 0.0} | own
    unlogged = {"type": "latent_source", "waveform_of": SOURCES[source]} | own
    found: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind, effect in (("found", unlogged), ("told", told)):
            for which, seed in (("survey", 5), ("verify", 6)):
                description = scenario(seed, sensors, motion, 0.01, effect) | {"truth": "effects"}
                if kind == "told":
                    description["channels"] = description["channels"] | {"hidden": SOURCES[source]}
                write(simulate(description), folder / f"{kind}_{which}.h5")
            recipe = yaml.safe_load(RECIPE.read_text())
            if kind == "told":
                declared = {"declared": {"channel_response": {"channel": "hidden"}}, "search": []}
                recipe["stages"][recipe["stages"].index("close_loop")] = {"close_loop": declared}
            path = folder / f"{kind}.yaml"
            path.write_text(yaml.safe_dump(recipe))
            run_recipe(path, folder / kind, survey=folder / f"{kind}_survey.h5", verify=folder / f"{kind}_verify.h5")
            found[kind] = json.loads((folder / kind / "verdict.json").read_text())
    cells = [", ".join(a["error_model"] for a in found["found"]["adopted"]) or "nothing"]
    for figure in ("total_field_rms_nT", "tensor_rms_nT_per_m"):
        before, after = (found["found"]["error"]["verify"][k][figure]["all"] for k in ("before", "after"))
        oracle = found["told"]["error"]["verify"]["after"][figure]["all"]
        cells.append(f"{before:.3g} -> {after:.3g} ({oracle:.3g})")
    return " | ".join(cells)


def main() -> None:
    """Run the study and write its tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clean", type=int, default=0, help="clean surveys of each array, motion and noise")
    parser.add_argument("--turning", action="store_true", help="effects of attitude that the search does not know")
    parser.add_argument("--power", type=int, default=0, help="surveys of each source and amplitude")
    parser.add_argument("--verify", action="store_true", help="errors on a second survey")
    parser.add_argument("--output", type=Path, help="write the tables here as well")
    chosen = parser.parse_args()
    lines: list[str] = []

    def tell(line: str) -> None:
        lines.append(line)
        print(line, flush=True)
        if chosen.output:
            words = (__doc__ or "").split("\n\n", 2)[2]
            command = f"`python studies/latent_study.py {' '.join(sys.argv[1:])}`"
            chosen.output.write_text(
                "\n".join(["# Sources that nobody logged, on simulated surveys", "", words, command, *lines, ""])
            )

    if chosen.clean:
        tell("\n## Clean surveys\n\n| sensors | motion | noise | surveys | significant | adopted |")
        tell("|---|---|---|---|---|---|")
        for sensors in ARRAYS:
            for motion in MOTIONS:
                for flicker in (0.0, 0.01):
                    surveys = [scenario(3000 + k, sensors, motion, flicker) for k in range(chosen.clean)]
                    tell(f"| {sensors} | {motion} | {'white and 1/f' if flicker else 'white'} | {counted(surveys)} |")
    if chosen.turning:
        tell("\n## Instead of another effect\n\n| effects | motion | surveys | significant | adopted |")
        tell("|---|---|---|---|---|")
        for motion in MOTIONS:
            for amplitude in (1.0, 10.0):
                effects = [{"type": n, "rms_nT": amplitude * NOISE_NT} | EFFECTS.get(n, {}) for n in TURNING]
                late = ("sampling_lag", "clock_drift") if motion == "postures" else ()  # cannot be simulated there
                surveys = [scenario(7, 4, motion, 0.01, e) for e in effects if e["type"] not in late]
                tell(f"| {len(surveys)} kinds, {amplitude:g} x noise | {motion} | {counted(surveys)} |")
    if chosen.power:
        tell("\n## Surveys with a source\n\n| sensors | source | motion | surveys | significant | adopted |")
        tell("|---|---|---|---|---|---|")
        for sensors in (3, 4):
            for source, waveform in SOURCES.items():
                for amplitude in (0.1, 0.3, 1.0):
                    for motion in ("tumbling", "postures"):
                        effect = {"type": "latent_source", "rms_nT": amplitude * NOISE_NT, "waveform_of": waveform}
                        surveys = [scenario(4000 + k, sensors, motion, 0.01, effect) for k in range(chosen.power)]
                        tell(f"| {sensors} | {source}, {amplitude:g} x noise | {motion} | {counted(surveys)} |")
    if chosen.verify:
        tell("\n## Verification\n\nBefore -> after (told the waveform).\n")
        tell("| sensors | source | motion | adopted | total field, nT | tensor, nT/m |\n|---|---|---|---|---|---|")
        for sensors in (4, 3):
            for motion in ("tumbling", "postures") if sensors == 4 else ("tumbling",):
                for source in SOURCES:
                    for amplitude in (1.0, 30.0):
                        row = verified(sensors, motion, source, amplitude)
                        tell(f"| {sensors} | {source}, {amplitude:g} x noise | {motion} | {row} |")


if __name__ == "__main__":
    main()
