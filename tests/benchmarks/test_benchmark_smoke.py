"""The benchmark runs and prints a row for every pipeline; its figures are for people, not for tests."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks/pipeline.py"


def test_the_quick_benchmark_prints_every_pipeline() -> None:
    done = subprocess.run([sys.executable, str(SCRIPT), "--quick"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = [line.split("|")[2].strip() for line in done.stdout.splitlines()[2:]]
    assert rows == ["Chi 2017", "Li 2018", "joint", "loop"]


def test_the_joint_benchmark_measures_and_says_what_it_left_out() -> None:
    script = SCRIPT.with_name("joint.py")
    for name in ("magtensor joint", "magtensor joint, from disk"):
        command = [sys.executable, str(script), "--worker", name, "20000", "1"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        figures = json.loads(done.stdout)
        # 3 nT over the square root of so many samples, nine parameters
        assert 0 < figures["error_nT"] < 5 * 3.0 * 3.0 / 20_000**0.5
        assert figures["seconds"] > 0 and figures["peak_MB"] > 20
    for name, python, reason in (
        ("joint.PEER", "'/bin/false'", "no reason given"),
        ("joint.SCRIPT", "sys.executable", "no script named with --nliaudat"),
    ):
        code = f"import joint, sys; print(joint.measured({name}, 1000, 1, {python}))"
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=script.parent)
        assert done.stdout.strip() == reason
