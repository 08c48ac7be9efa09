"""The closed loop's cost: seconds, seconds of CPU and peak memory of `magtensor run recipes/closed_loop.yaml`.

`python benchmarks/closed_loop.py [--samples N,N]` simulates surveys of four sensors with one undeclared effect, of
18 000 samples (half an hour at 10 Hz) and of a million (nearly three hours at 100 Hz), and runs the recipe on each in
a process of its own, reading, report and results included, the work shared out among the cores.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "studies"))

from loop_surveys import scenario

from magtensor.simulate import simulate, write

ROOT = Path(__file__).resolve().parents[1]
RATES = {18_000: 10.0, 1_000_000: 100.0}  # Hz


def cost(survey: Path, output: Path) -> tuple[float, float, float, str]:
    """Seconds, seconds of CPU of all processes, peak MB of the largest and the last line of the run."""
    child = (
        "import resource, subprocess, sys; done = subprocess.run(sys.argv[1:]); "
        "used = resource.getrusage(resource.RUSAGE_CHILDREN); "
        "print(used.ru_utime + used.ru_stime, used.ru_maxrss // 1024); sys.exit(done.returncode)"
    )
    arguments = ["run", str(ROOT / "recipes" / "closed_loop.yaml"), "--input", str(survey), "--output", str(output)]
    command = [sys.executable, "-c", child, sys.executable, "-m", "magtensor", *arguments]
    begin = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OPENBLAS_NUM_THREADS": "1"})
    elapsed = time.perf_counter() - begin
    if done.returncode:
        raise SystemExit(done.stderr)
    *lines, used = done.stdout.splitlines()
    seconds, peak = used.split()
    return elapsed, float(seconds), float(peak), lines[-1]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", default=",".join(map(str, RATES)), help="of each survey")
    print(f"{'samples':>10} {'s':>7} {'CPU s':>7} {'peak MB':>8}")
    for samples in map(int, parser.parse_args().samples.split(",")):
        rate = RATES.get(samples, 10.0)
        made = scenario("tumbling", 0.02, 1, "temperature_offset", 5.0) | {"rate_Hz": rate}
        made["motion"] = made["motion"] | {"duration_s": samples / rate}
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "survey.h5"
            write(simulate(made), path)
            elapsed, seconds, peak, verdict = cost(path, Path(folder) / "out")
        print(f"{samples:10d} {elapsed:7.1f} {seconds:7.1f} {peak:8.0f}  {verdict}", flush=True)


if __name__ == "__main__":
    main()
