"""What each stage costs: seconds of CPU and peak memory of whole runs, `python benchmarks/pipeline.py [--quick]`.

Compare figures of one run only: the machine is part of them. Each recipe runs in a process of its own on the same
simulated survey (four sensors), so that the peak memory is that recipe's.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PIPELINES = {
    "Chi 2017": ["load", {"detrend_diurnal": {"uncovered": "mask"}}, "calibrate_scalar", "align", "assemble_tensor"],
    "Li 2018": [
        "load",
        {"detrend_diurnal": {"uncovered": "mask"}},
        {"calibrate_array": {"method": "li2018"}},
        "assemble_tensor",
    ],
    "joint": ["load", {"detrend_diurnal": {"uncovered": "mask"}}, "calibrate_joint", "assemble_tensor"],
    "loop": ["load", {"detrend_diurnal": {"uncovered": "mask"}}, "close_loop", "assemble_tensor"],
}


def worker(recipe: str, survey: str) -> None:
    """Run one recipe and print its stages' CPU seconds and the process's peak memory as JSON."""
    import time

    from magtensor.preparing import empty_survey
    from magtensor.recipe.plan import plan
    from magtensor.recipe.source import parse_yaml
    from magtensor.runner import run_stage

    planned = plan(parse_yaml(recipe, "benchmark"), survey=Path(survey))
    state = empty_survey(planned)
    seconds = {}
    for stage in planned.stages:
        begin = time.process_time()
        state, _ = run_stage(stage, state)
        seconds[stage.name] = time.process_time() - begin
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"seconds": seconds, "peak_MB": peak}))


def main() -> None:
    """Simulate surveys of growing length and print a row for each recipe."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="the shortest survey only")
    parser.add_argument("--worker", nargs=2, metavar=("RECIPE", "SURVEY"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.worker:
        worker(*chosen.worker)
        return
    from magtensor.simulate.command import simulate_file

    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    print("| samples | pipeline | CPU s of the stages | peak MB | slowest stage |")
    print("|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for rate in (1.0,) if chosen.quick else (1.0, 10.0, 100.0):
            survey = Path(folder) / f"{rate:g}.h5"
            simulate_file(ROOT / "recipes/scenarios/demo.yaml", survey, [f"rate_Hz={rate}"])
            for name, stages in PIPELINES.items():
                recipe = json.dumps({"title": name, "stages": stages})
                command = [sys.executable, __file__, "--worker", recipe, str(survey)]
                done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
                figures = json.loads(done.stdout)
                seconds = figures["seconds"]
                slowest = max(seconds, key=lambda s: seconds[s])
                total = sum(seconds.values())
                print(
                    f"| {int(1800 * rate)} | {name} | {total:.2f} | {figures['peak_MB']:.0f} "
                    f"| {slowest} {seconds[slowest]:.2f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
