"""Events along one vector are said to be so: one thing may have switched."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from loop_cases import Array, synthetic

from magtensor.loop.fitting.model import Fitting
from magtensor.loop.searching.search import search
from magtensor.loop.searching.unexplained import unexplained
from magtensor.registry import Registry

SAMPLES = 1500


def told(vectors: Array) -> dict[str, Any]:
    """What is said beside two events of the vectors (2, 4, 3) nT."""
    added = np.zeros((SAMPLES, 4, 3))
    for vector, (begin, end) in zip(vectors, ((250, 480), (900, 1180)), strict=True):
        added[begin:end] += vector
    record = synthetic(4, SAMPLES, noise_nT=0.2, added=added, turning_s=4.0)
    found = search(record, [Registry.load().find("error_model", "offset_while")], Fitting())
    assert [a.name for a in found.last.adopted] == ["offset_while"] * 2
    return unexplained(found, record)


@pytest.mark.parametrize("times", [1.0, -0.6])
def test_two_events_of_one_thing_are_said_to_be_along_one_vector(times: float) -> None:
    one = np.random.default_rng(1).standard_normal((4, 3))
    said = told(np.stack([one, times * one]))
    assert not said["present"]
    (words,) = [w for w in said["notes"] if "along one vector" in w]
    first, second = (float(part.split(" s")[0]) for part in words.split(" at ")[1:])
    assert sorted([first, second]) == pytest.approx([250.0, 900.0], abs=2.0)
    assert "one thing in S1, S2, S3, S4 switches" in words


def test_two_events_of_vectors_of_their_own_are_not() -> None:
    assert not any("along one vector" in w for w in told(np.random.default_rng(2).standard_normal((2, 4, 3)))["notes"])
