"""What happened once, seen at the edges of a stretch that was taken out because nothing explains it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loop_cases import synthetic

from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.fitting.model import Adopted, Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.beside_a_hole import of_a_hole
from magtensor.registry import Registry

SAMPLES, ALPHA, MODELS = 1500, 0.005, 40
PASSING = Registry.load().find("error_model", "passing_source")
MIDDLE, PASSAGE_S = 700.0, 40.0


def restless(rng: np.random.Generator) -> np.ndarray:
    """(N,) nT rms 0.6, what a station read once a minute misses of the field: humps as long as that is."""
    within = np.arange(-60.0, 61.0)
    humps = np.convolve(rng.standard_normal(SAMPLES), np.exp(-0.5 * (within / 15.0) ** 2), mode="same")
    return np.asarray(0.6 * humps / humps.std())


@pytest.mark.parametrize("passed", [True, False])
@pytest.mark.parametrize("away_s", [25.0, 300.0])
def test_an_event_beside_a_hole_is_one_with_what_was_in_it(passed: bool, away_s: float) -> None:
    """The top of a hump that is no event is taken out, 25 s from where one would have passed; or other samples are."""
    rng = np.random.default_rng(3)
    made = synthetic(3, SAMPLES, noise_nT=0.2)
    time = made.time
    model = Adopted(PASSING, {"time_s": MIDDLE, "passage_s": PASSAGE_S})
    u = (time - MIDDLE) / PASSAGE_S
    source = 6.0 * (1.0 + u**2) ** -2.5 * (1.0 - 0.5 * u)  # one combination of Anderson's functions
    top = np.abs(time - MIDDLE - away_s) < 15.0
    misses = source + 0.1 * restless(rng) if passed else np.where(top, 4.0, 0.0) + 0.1 * source + restless(rng)
    record = replace(made, quiet_field=made.total_field - misses, total_field=made.total_field - misses)
    how = Fitting()
    whole = joint_state(record, [], how)
    without = joint_state(record, [], replace(how, without=((MIDDLE + away_s - 15.0, MIDDLE + away_s + 15.0),)))
    assert len(without.residual.samples) < len(whole.residual.samples)
    terms = model.terms(without.excitation).at(without.residual.samples)
    seen = OwnNoise(without.residual, None).p_value(terms) < 1e-12
    assert seen is (passed or away_s < PASSAGE_S)
    chosen: Any = SimpleNamespace(model=model, tried=100.0, alpha=ALPHA)
    why = of_a_hole(chosen, without, whole, MODELS)
    assert bool(why) is (seen and not passed)
