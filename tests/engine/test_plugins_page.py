"""The page on plugins: its file loads, its recipe runs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from magtensor.cli import status_of

PAGE = Path(__file__).parents[2] / "docs" / "plugins.md"


def test_the_example_runs_as_it_stands(tmp_path, capsys):
    text = PAGE.read_text()
    (code,), (recipe,) = (re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL) for kind in ("python", "yaml"))
    (tmp_path / "my_plugins").mkdir()
    (tmp_path / "my_plugins" / "own.py").write_text(code)
    (tmp_path / "recipe.yaml").write_text(recipe)
    time = np.arange(2000) * 0.1
    angle = np.stack([0.11 * time, 0.071 * time])
    field = 5e4 * np.stack(
        [np.cos(angle[0]) * np.cos(angle[1]), np.sin(angle[0]) * np.cos(angle[1]), np.sin(angle[1])], axis=1
    )
    noise = np.random.default_rng(1).normal(size=field.shape)
    np.savez(tmp_path / "s.npz", t=time, m=field + noise, F=np.full(len(time), 5e4))
    said = status_of(["run", str(tmp_path / "recipe.yaml"), "--output", str(tmp_path / "out")])
    assert said == 0, capsys.readouterr().err
    capsys.readouterr()
    assert status_of(["inspect", str(tmp_path / "s.npz"), "--plugins", str(tmp_path / "my_plugins")]) == 0
    assert "S1: {from: m" in capsys.readouterr().out
