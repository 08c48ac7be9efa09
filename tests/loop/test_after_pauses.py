"""Samples taken before the rig has come to rest: of each posture the first."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import scenario, verdict_of

from magtensor.loop.remainder.flagged import after_pauses

POSTURES = {"type": "postures", "random_count": 40, "rest_s": 8.0, "turn_s": 3.0}
STARTS = np.arange(0, 400, 10)


def runs() -> Any:
    """Forty runs of ten samples."""
    return SimpleNamespace(runs=lambda: [(int(a), int(a) + 10) for a in STARTS])


def test_bad_beginnings_are_found_with_the_samples_behind_them() -> None:
    bad = np.zeros(400, dtype=bool)
    bad[STARTS[1:30]] = True
    bad[STARTS[1:10] + 1] = True
    bad[[25, 137, 304]] = True  # spikes
    found, words = after_pauses(bad, runs())
    assert found.sum() == 29 + 9 and not found[[25, 137, 304]].any()
    assert "29 of 39 pauses" in words


@pytest.mark.parametrize("seed", range(5))
def test_spikes_anywhere_are_none(seed: int) -> None:
    bad = np.random.default_rng(seed).random(400) < 0.1
    assert not after_pauses(bad, runs())[0].any()
    assert not after_pauses(np.zeros(400, dtype=bool), runs())[0].any()


def restless(path: Path) -> None:
    """The first row of every posture is some 20 nT off."""
    with h5py.File(path, "r+") as survey:
        raw, time = survey["b_raw"][()], survey["time"][()]
        first = np.flatnonzero(np.diff(time, prepend=-10.0) > 1.0)
        raw[first] += 20.0 * np.random.default_rng(1).standard_normal((len(first), *raw.shape[1:]))
        survey["b_raw"][...] = raw


def test_it_is_told(tmp_path: Path) -> None:
    found = verdict_of(tmp_path, scenario(3, motion=POSTURES), restless, [])
    assert found["unexplained"]["present"]
    assert "come first after 39 of 39 pauses" in found["unexplained"]["description"]
    assert found["error"]["held_out"]["before"]["total_field_rms_nT"]["all"] < 0.3
