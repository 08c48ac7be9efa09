"""A few bad rows of a recorder, wherever they are, are no source that nobody logged: they are flagged."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import scenario, survey_file

import magtensor

SEARCHED = ["latent_source", "passing_source", "offset_step"]


@pytest.mark.parametrize(
    ("first", "count", "told"),
    [
        (0, 1, False),
        (-1, 1, False),
        pytest.param(-2, 2, False, marks=pytest.mark.long),
        (0, 10, True),
        pytest.param(1200, 3, True, marks=pytest.mark.long),
    ],
)
def test_they_are_flagged(tmp_path: Path, first: int, count: int, told: bool) -> None:
    path = survey_file(tmp_path, scenario(3))
    with h5py.File(path, "r+") as file:
        rows = np.arange(first, first + count) % len(file["b_raw"])
        for row in rows:
            file["b_raw"][row] += 300.0 * np.random.default_rng(3).standard_normal((4, 3))
    done = magtensor.close_loop(path, search=SEARCHED)
    assert done.verdict["adopted"] == []
    assert done.verdict["noise_floor_nT"] == pytest.approx(0.15, abs=0.01)
    assert not done.computed.survey.good[rows].any()
    left = done.verdict["unexplained"]
    assert left["present"] == told
    assert not told or f"{count} samples in 1 stretch" in left["description"]
