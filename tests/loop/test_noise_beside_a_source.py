"""What noise the outputs have beside a source nobody logged: no output is left next to none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import linear_state, synthetic
from scipy.signal import lfilter
from test_loop_latent import MODEL

from magtensor.loop.fitting.model import Fitting, Record
from magtensor.loop.searching.latent import sought, tried_source
from magtensor.tensor.geometry import standard_geometry


def one_way(seed: int, time_s: float, size_nT: float) -> Record:
    """A source that acts one way only, felt most by one output, in noise of 1 nT."""
    rng = np.random.default_rng(seed)
    kept = np.exp(-1.0 / time_s)
    wave = np.maximum(lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], rng.standard_normal(3000)), 0.0)
    vectors = 0.8 * rng.standard_normal((4, 3))
    vectors[1, 1] += 4.0
    record = synthetic(seed, 3000, added=size_nT * wave[:, None, None] * vectors)
    return replace(record, position=standard_geometry("cross", 0.5))


@pytest.mark.parametrize(("time_s", "size_nT", "seed"), [(40.0, 0.5, 6), (40.0, 0.5, 8), (15.0, 0.5, 7), (3.0, 1.0, 6)])
def test_every_output_has_its_noise(time_s: float, size_nT: float, seed: int) -> None:
    """In each of these one output takes all of its noise for the source's, and a tenth of it would be left."""
    record = one_way(seed, time_s, size_nT)
    state = linear_state(record)
    found = sought(state, record)
    assert found is not None
    found, source = tried_source(MODEL, record, state, found, Fitting(), 0.005)
    assert source is not None, found.objection
    noise = source.after.adopted[-1].settings["noise_nT"]
    np.testing.assert_allclose(noise, 1.0, atol=0.35)


def test_what_a_correction_would_not_take_off_is_not_adopted() -> None:
    """Of a source that acts as a gradient would, no survey shows anything that no field could make."""
    rng = np.random.default_rng(4)
    position = standard_geometry("cross", 0.5)
    gradient = np.array([[1.0, 0.3, -0.4], [0.3, -0.6, 0.8], [-0.4, 0.8, -0.4]])
    wave = np.convolve(rng.standard_normal(3000), np.ones(30) / 30**0.5, mode="same")
    record = replace(synthetic(4, 3000, added=6.0 * wave[:, None, None] * (position @ gradient)), position=position)
    state = linear_state(record)
    found = sought(state, record)
    assert found is not None and found.significant and not found.objection
    found, source = tried_source(MODEL, record, state, found, Fitting(), 0.005)
    assert source is None and "a correction would not take it off" in found.objection
