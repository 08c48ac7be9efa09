"""The benchmark runs and prints a row for every pipeline; its figures are for people, not for tests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks/pipeline.py"


def test_the_quick_benchmark_prints_every_pipeline() -> None:
    done = subprocess.run([sys.executable, str(SCRIPT), "--quick"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = [line.split("|")[2].strip() for line in done.stdout.splitlines()[2:]]
    assert rows == ["Chi 2017", "Li 2018", "joint", "loop"]
