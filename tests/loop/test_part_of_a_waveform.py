"""A channel that goes with what moves all sensors now and then, and the one that moves them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loop_cases import linear_state, synthetic
from scipy.ndimage import gaussian_filter1d

from magtensor.loop.fitting.model import Adopted
from magtensor.loop.searching.part_of_a_waveform import part_of_a_waveform
from magtensor.registry import Registry

SAMPLES = 1500


def slow(rng: np.random.Generator, over_s: float) -> np.ndarray:
    """(N,) of unit rms."""
    course = gaussian_filter1d(rng.standard_normal(SAMPLES), over_s, mode="wrap")
    return np.asarray((course - course.mean()) / course.std())


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("sensors", [4, 1])
def test_noise_of_each_sensor_tells_nothing_of_what_moves_them_all(seed: int, sensors: int) -> None:
    rng = np.random.default_rng(seed)
    cause, other = slow(rng, 12.0), slow(rng, 25.0)
    noise = np.array([slow(rng, 12.0) for _ in range(3 * sensors)]).T.reshape(SAMPLES, sensors, 3)
    for shared in (True, False):
        moved = cause[:, None, None] * rng.standard_normal((sensors, 3)) if shared else noise
        made = synthetic(seed, SAMPLES, sensors, noise_nT=0.2, added=0.4 * moved, turning_s=5.0)
        logged = {"cause": cause + 0.1 * rng.standard_normal(SAMPLES), "other": other}
        record = replace(made, logged=logged, units=dict.fromkeys(logged, "1"), origins=dict.fromkeys(logged, 0.0))
        # what the sensors share must not go as a channel, or it is no source nobody logged
        state = linear_state(replace(record, logged={"other": other} if shared else logged))
        for channel in ("cause", "other"):
            model = Adopted(Registry.load().find("error_model", "channel_response"), {"channel": channel})
            terms = model.terms(replace(state.excitation, logged=logged)).at(state.residual.samples)
            chosen: Any = SimpleNamespace(
                model=model, terms=terms, adjusted_p=1.0, alpha=0.005, beyond_own_noise=True, before=None, moved=None
            )
            seen = replace(record, logged={"other": other})
            refused = bool(part_of_a_waveform(chosen, state, seen))
            assert refused is (shared and sensors > 1 and channel == "other")
            for known in ({"adjusted_p": 1e-4}, {"beyond_own_noise": False}):
                chosen_by = SimpleNamespace(**{**vars(chosen), **known})
                assert not part_of_a_waveform(chosen_by, state, seen)  # type: ignore[arg-type]
