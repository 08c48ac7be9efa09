"""Runs of a few samples between gaps, too short for a rate of change to be known and checked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import linear_state, synthetic

from magtensor.error_models.needs import missing
from magtensor.registry import Registry


@pytest.mark.parametrize("samples", range(1, 14))
def test_a_fragment_between_gaps_is_no_failure(samples: int) -> None:
    record = synthetic(3, turning_s=20.0)
    run = np.repeat([0, 1, 2], [500, samples, len(record.time) - 500 - samples])
    excitation = linear_state(replace(record, run=run)).excitation
    assert missing(Registry.load().find("error_model", "sampling_lag"), excitation) == []
