"""A sensor that is wrong for a while, by thousands of nT and by no law of an event, is flagged while it is: it spoils
neither the calibration nor the search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import Array, scenario, survey_file, synthetic

import magtensor
from magtensor.errors import DataError
from magtensor.loop.evidence.stretches import louder_in
from magtensor.loop.fitting.model import Fitting
from magtensor.loop.searching.search import search
from magtensor.registry import Registry

SEARCHED = ["offset_while", "offset_step", "temperature_offset"]


def x_negated(b: Array) -> Array:
    return b * [-1.0, 1.0, 1.0]


def x_and_y_exchanged(b: Array) -> Array:
    return b[:, [1, 0, 2]]


def twice_on_z(b: Array) -> Array:
    return b * [1.0, 1.0, 2.0]


@pytest.mark.long
@pytest.mark.parametrize(
    ("wrong", "first", "count", "effect"),
    [
        (x_negated, 1440, 96, True),
        (twice_on_z, 1680, 240, False),
        (x_negated, 1440, 96, False),
        (x_negated, 720, 440, False),
        (x_negated, 720, 440, True),
        (x_and_y_exchanged, 720, 288, True),
        (twice_on_z, 1680, 240, True),
    ],
)
def test_it_is_flagged(wrong: Callable[[Array], Array], first: int, count: int, effect: bool, tmp_path: Path) -> None:
    effects = [{"type": "temperature_offset", "rms_nT": 0.5}] if effect else []
    path = survey_file(tmp_path, scenario(4, *effects))
    with h5py.File(path, "r+") as file:
        rows = slice(first, first + count)
        file["b_raw"][rows, 1] = wrong(file["b_raw"][rows, 1])
    done = magtensor.close_loop(path, search=SEARCHED)
    assert [a["error_model"] for a in done.verdict["adopted"]] == ["temperature_offset"] * effect
    assert done.verdict["unexplained"]["present"]
    assert "mostly on S2" in done.verdict["unexplained"]["description"]
    assert done.verdict["noise_floor_nT"] == pytest.approx(0.15, abs=0.01)
    good = done.computed.survey.good
    assert not good[rows].any()
    assert good[: max(first - 20, 0)].mean() > 0.99 and good[first + count + 20 :].mean() > 0.99
    assert done.verdict["error"]["held_out"]["after"]["total_field_rms_nT"]["S2"] < 0.2


def test_of_a_stretch_that_is_doubted_most_is_louder_or_nothing() -> None:
    """Samples that come near the others now and then are none of the others'; noise that is louder is believed."""
    rng = np.random.default_rng(8)
    values, keep = rng.standard_normal((2000, 9)), np.ones(2000, dtype=bool)
    values[700:800] += 3000.0 * np.sin(np.arange(100) / 2.0)[:, None]
    keep[700:800] = np.abs(values[700:800]).max(axis=1) < 10.0
    assert not louder_in(keep, [(9, values)])[701:799].any()
    loud = rng.standard_normal((2000, 9))
    loud[700:800] *= 30.0
    assert louder_in(keep, [(9, loud)])[720:780].all()


def test_what_is_wrong_throughout_is_not_said_to_lack_attitudes(tmp_path: Path) -> None:
    path = survey_file(tmp_path, scenario(3, rate_Hz=0.5))
    with h5py.File(path, "a") as file:
        file["b_raw"][:, 2] *= np.array([1.0, -1.0, 1.0])
    with pytest.raises(DataError, match="y axis of sensor 3 is inverted") as refused:
        magtensor.close_loop(path, search=SEARCHED)
    assert "attitudes" not in str(refused.value) and "nominal" not in str(refused.value)


@pytest.mark.long
def test_what_a_wrong_sensor_spoils_elsewhere_is_no_noise() -> None:
    """With its samples in the fit what is left grows as the platform turns, in all sensors, as if these were loud."""
    record = synthetic(3, samples=2400, noise_nT=0.2, turning_s=60.0)
    raw, wrong = np.array(record.raw), slice(500, 620)
    raw[wrong, 2] = x_negated(raw[wrong, 2])
    record, registry = replace(record, raw=raw), Registry.load()
    models = [registry.find("error_model", name) for name in ("offset_while", "latent_source")]
    found = search(record, models, Fitting())
    assert [a.name for a in found.last.adopted] == []
    assert not found.last.fit.keep[wrong].any() and found.last.fit.keep.sum() == 2280
    assert found.shared is None or not found.shared.significant
