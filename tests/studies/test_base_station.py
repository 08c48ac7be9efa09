"""The study of base stations that are read seldom: its trials differ, and what is lost is lost in the middle."""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))

import base_station


def test_no_two_trials_have_one_field() -> None:
    trials = list(base_station.planned(2))
    assert len({t.seed for t in trials}) == len(trials) == 2 * (48 + 32)
    assert {t.every_s for t in trials if t.lost} == {1.0, 2.0, 5.0, 10.0}


def test_readings_are_lost_in_the_middle(tmp_path: Path) -> None:
    path = tmp_path / "survey.h5"
    with h5py.File(path, "w") as file:
        for name in ("time", "total_field"):
            file[f"reference/{name}"] = np.arange(20.0)
            file[f"reference/{name}"].attrs["units"] = "1"
    base_station.lose(path, 3)
    with h5py.File(path) as file:
        for name in ("time", "total_field"):
            np.testing.assert_array_equal(file[f"reference/{name}"], np.delete(np.arange(20.0), [10, 11, 12]))
            assert file[f"reference/{name}"].attrs["units"] == "1"
