"""The transfer curve of an axis that is no power of what it reads: found as straight lines that bend, or told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, linear_state, synthetic

from magtensor.error_models.curves import bends_of
from magtensor.loop.fitting.model import Fitting, Record
from magtensor.loop.remainder.curve_of_a_channel import event_of_an_axis
from magtensor.loop.searching import by_hand
from magtensor.loop.searching.found import Search
from magtensor.loop.searching.gates import ALPHA
from magtensor.loop.searching.keeping import OF_AN_AXIS
from magtensor.loop.searching.search import search
from magtensor.loop.searching.unexplained import unexplained
from magtensor.registry import Registry

SAMPLES = 2000
MODELS = ("nonlinearity_quadratic", "nonlinearity_cubic", "cross_field", "hysteresis", "offset_while", "latent_source")
CURVES = {"nonlinearity_quadratic", "nonlinearity_cubic"}


def found(record: Record) -> Search:
    registry = Registry.load()
    return search(record, [registry.find("error_model", name) for name in MODELS], Fitting())


def distorted(seed: int, law: Callable[[Array], Array], **survey: float) -> Record:
    """A survey in which every axis adds a law of what it reads, in a proportion of its own."""
    rng = np.random.default_rng(seed + 50)
    share = rng.uniform(0.3, 1.5, (4, 3)) * rng.choice([-1.0, 1.0], (4, 3))
    record = synthetic(seed, SAMPLES, **survey)  # type: ignore[arg-type]
    return replace(record, raw=record.raw + share * law(record.raw))


@pytest.mark.parametrize(
    "law",
    [
        pytest.param(lambda m: 5e-5 * np.maximum(m, 0.0), id="a gain that differs for either sign"),
        pytest.param(
            lambda m: 0.5 * np.sin(2.0 * np.pi * m / 20_000.0), id="a converter's wave", marks=pytest.mark.long
        ),
        pytest.param(
            lambda m: -3.0 * np.sign(m) * (np.abs(m) / 50_000.0) ** 9, id="saturation", marks=pytest.mark.long
        ),
    ],
)
def test_a_curve_that_is_no_power_is_found(law: Callable[[Array], Array]) -> None:
    result = found(distorted(1, law))
    adopted = result.last.adopted
    assert {model.name for model in adopted} <= CURVES
    assert any(model.settings["bends"] for model in adopted)
    # 2000 samples of white noise of 1 nT, of which a hundred coefficients take a twentieth at most
    assert float(np.mean(result.last.residual.noise)) == pytest.approx(1.0, abs=0.04)
    assert not unexplained(result, distorted(1, law))["present"]


def test_another_law_of_the_attitude_is_no_curve_of_an_axis() -> None:
    """Every axis adds the product of all three, which none of them reads: told, and not blamed on what it reads."""

    def product(m: Array) -> Array:
        out: Array = 8.0 * np.prod(m / 50_000.0, axis=2, keepdims=True)
        return out

    result = found(distorted(2, product))
    assert result.last.adopted == ()
    assert "predicted from the direction of the field" in unexplained(result, result.record)["description"]


@pytest.mark.parametrize("power", [2, 3])
def test_a_power_stays_one(power: int) -> None:
    result = found(distorted(3, lambda m: 3.0 * (m / 50_000.0) ** power))
    (model,) = result.last.adopted
    assert model.name in CURVES and not model.settings["bends"]


def held_reading(of_an_axis: bool) -> Record:
    """A platform that turns slowly, and a dead zone of one axis, in which it stays for a while each time; or something
    that did happen, on that axis alone."""
    record = synthetic(4, SAMPLES, turning_s=30.0)
    raw, reads = record.raw.copy(), record.raw[:, 0, 0]
    if of_an_axis:
        dead = np.abs(reads) < 6000.0
        raw[:, 0, 0] += np.where(dead, -4.5 * reads / 6000.0, 4.5 * np.sign(reads) * (np.abs(reads) < 12000.0))
    else:
        raw[900:960, 0, 0] += 8.0
    return replace(record, raw=raw)


@pytest.mark.parametrize("of_an_axis", [True, False])
def test_what_lasts_while_an_axis_reads_next_to_nothing_is_no_event(of_an_axis: bool) -> None:
    state = linear_state(held_reading(of_an_axis))
    one = by_hand.candidate(Registry.load().find("error_model", "offset_while"), {}, state, 30, ALPHA)
    theta = one.assessment.theta[-one.terms.count :]
    assert event_of_an_axis(state, one.terms, theta, one.assessment.colours) is of_an_axis


@pytest.mark.long
@pytest.mark.parametrize("of_an_axis", [True, False])
def test_it_is_a_curve_of_that_axis(of_an_axis: bool) -> None:
    result = found(held_reading(of_an_axis))
    (adopted,) = result.last.adopted
    assert adopted.sensors == ("S1",)
    assert adopted.name in CURVES if of_an_axis else adopted.name == "offset_while"
    assert (result.steps[0].refused.get("offset_while") == OF_AN_AXIS) is of_an_axis


def test_a_bend_is_where_any_of_the_axes_was_twice() -> None:
    there = np.tile(np.linspace(0.0, 1.0, 100), 10)
    never = np.full(1000, 3.0)
    assert bends_of(np.column_stack([there, never]), 6) == (0.5, 1.0)
    assert bends_of(there, 4) == (0.25, 0.5, 0.75)


@pytest.mark.parametrize("seed", [6, *(pytest.param(seed, marks=pytest.mark.long) for seed in (8, 10))])
def test_an_axis_that_bends_near_its_largest_output(seed: int) -> None:
    """A fifteenth of the samples or less, in stretches, which fit nothing else, by up to 45 nT."""
    record = synthetic(seed, 1500, turning_s=8.0)
    raw = record.raw.copy()
    raw[:, 0, 0] -= 0.01 * np.maximum(raw[:, 0, 0] - 45_000.0, 0.0)
    last = found(replace(record, raw=raw)).last
    (one,) = last.adopted
    assert one.component.name.startswith("nonlinearity") and one.sensors == ("S1",)
    assert min(abs(bend - 45_000.0) for bend in one.settings["bends"]) < 300.0
    assert len(one.settings["bends"]) <= 2  # one, and what chance may ask for
    assert last.fit.keep.mean() > 0.995 and last.residual.square() < 1.1
