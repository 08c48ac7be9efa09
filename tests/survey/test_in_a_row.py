"""Runs of samples, against a walk from one sample to the next."""

from __future__ import annotations

import numpy as np
import pytest

from magtensor.in_a_row import in_a_row


def walked(some: list[bool]) -> list[list[int]]:
    found: list[list[int]] = []
    for i, one in enumerate(some):
        if one and i and some[i - 1]:
            found[-1][1] = i + 1
        elif one:
            found.append([i, i + 1])
    return found


@pytest.mark.parametrize("share", [0.0, 0.3, 0.8, 1.0])
@pytest.mark.parametrize("count", [0, 1, 40])
def test_runs_of_samples(share: float, count: int) -> None:
    some = np.random.default_rng(4).random(count) < share
    assert in_a_row(some).tolist() == walked(some.tolist())
    assert in_a_row(some.astype(np.uint8)).tolist() == walked(some.tolist())
    assert in_a_row(some).shape[1] == 2
