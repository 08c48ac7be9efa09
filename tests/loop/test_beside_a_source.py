"""What shows in a gradient only: searched once the gradient of the calibration site is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import BASE, RECIPE, adopted_names, scenario, survey_file, verdict_of
from scipy.spatial.transform import Rotation

import magtensor
from magtensor.loop.fitting.model import Adopted, Fitting, Record
from magtensor.loop.fitting.record import record_of
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.seen import beside_the_site
from magtensor.preparing import load_as
from magtensor.recipe.plan import read_plan
from magtensor.registry import Registry

MODELS = ("site_gradient", "fixed_source", "frame_flexure", "position_error", "baseline_expansion", "crosstalk")
FIELD = {
    "earth": {"total_field_nT": 49500.0, "inclination_deg": 66.0, "declination_deg": 4.0},
    "dipoles": [{"position_m": [4.0, 2.0, -2.5], "moment_Am2": [60.0, -120.0, 240.0]}],
}
OFFSETS_MM = [[10.0, 0.0, 0.0], [0.0, -6.0, 4.0], [0.0, 0.0, 0.0], [0.0, 0.0, 8.0]]


def beside_a_magnet(*effects: dict[str, Any]) -> dict[str, Any]:
    """Gradients of 150 nT/m, of which curvature bends 30 nT/m from one end of the array to the other."""
    motion = BASE["motion"] | {"duration_s": 600.0}
    return scenario(3, *effects, field=FIELD, motion=motion, logging={"attitude": True, "acceleration": True})


@pytest.mark.long
def test_a_sensor_that_is_not_where_it_should_be(tmp_path: Path) -> None:
    effect = {"type": "position_error", "offset_m": (1e-3 * np.array(OFFSETS_MM)).tolist()}
    told = verdict_of(tmp_path, beside_a_magnet(effect), models=MODELS)
    assert adopted_names(told) == {"fixed_source", "position_error"}
    found = next(a for a in told["adopted"] if a["error_model"] == "position_error")
    values = {(one["sensor"], one["name"]): one["value"] for one in found["coefficients"]}
    shift = np.array([[values[f"S{i + 1}", axis] for axis in "xyz"] for i in range(4)])
    # but for what the source makes as well: a larger array, and nearly so a shift of all of it
    place = 0.25 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    shift, true = (d - place * np.sum(place * d) / np.sum(place**2) for d in (shift, np.array(OFFSETS_MM)))
    np.testing.assert_allclose(shift - shift.mean(axis=0), true - true.mean(axis=0), atol=0.6)
    before, after = (told["error"]["held_out"][k]["total_field_rms_nT"]["all"] for k in ("before", "after"))
    assert before > 5.0 and after < 0.25  # noise of 0.15 nT an axis and 0.1 nT of the base station


@pytest.mark.long
def test_sensors_that_are_where_they_should_be(tmp_path: Path) -> None:
    told = verdict_of(tmp_path, beside_a_magnet(), models=MODELS)
    assert adopted_names(told) == {"fixed_source"}
    assert told["not_tested"] == []


def test_a_uniform_site_shows_nothing_of_it(tmp_path: Path) -> None:
    uniform = beside_a_magnet() | {"field": FIELD | {"dipoles": []}}
    told = verdict_of(tmp_path, uniform, models=MODELS)
    lacks = {one["error_model"]: one["missing"] for one in told["not_tested"]}
    assert lacks == {n: ["gradient"] for n in ("position_error", "baseline_expansion", "crosstalk")}


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    path = survey_file(tmp_path_factory.mktemp("gradient"), beside_a_magnet())
    return record_of(load_as(read_plan(RECIPE, survey=path), path))


def test_the_gradient_is_that_of_the_site_turned_into_the_frame_of_the_field(record: Record) -> None:
    model = Adopted(Registry.load().find("error_model", "site_gradient"), {})
    x = joint_state(record, [], Fitting()).excitation
    assert x.site is None
    np.testing.assert_allclose(x.gradient, 0.0, atol=1e-9)
    xx, xy, xz, yy, yz = theta = np.array([30.0, -20.0, 50.0, 10.0, 5.0])
    world = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, -xx - yy]])
    assert record.attitude is not None
    turn = Rotation.from_quat(record.attitude).as_matrix()  # platform to world
    in_platform = np.swapaxes(turn, 1, 2) @ world @ turn
    # positions are in the platform's frame, the field in the common one
    expected = x.from_platform @ in_platform
    np.testing.assert_allclose(beside_the_site(x, [model], [theta]).gradient, expected, atol=0.02 * 50.0)


def test_a_source_that_is_not_fitted_yet_adds_nothing(record: Record) -> None:
    model = Adopted(Registry.load().find("error_model", "site_gradient"), {})
    x = joint_state(record, [], Fitting()).excitation
    assert beside_the_site(x, [model], [np.zeros(0)]) is x
    assert beside_the_site(x, [model], [np.ones(3)]) is x  # coefficients of other settings


def test_both_are_fitted_from_nothing(record: Record) -> None:
    """The first round knows no gradient yet: its rounding is no regressor, of which coefficients could be found."""
    registry = Registry.load()
    models = [("fixed_source", {"degree": 4}), ("position_error", {})]
    adopted = [Adopted(registry.find("error_model", name), settings) for name, settings in models]
    state = joint_state(record, adopted, Fitting())
    assert state.residual.square() < 1.5
    assert np.abs(state.theta[1]).max() < 2.0  # mm


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 3])
def test_what_an_effect_adds_along_the_vectors_of_a_source_is_not_left_in_its_waveform(
    tmp_path: Path, seed: int
) -> None:
    """A waveform may be anything: it takes what goes with the field and the temperature along its vectors, and of scale
    factors that follow the temperature what is left of them looks like axes that turn."""
    vectors = 8.0 * np.array([[0.9, -0.4, 0.6], [-0.5, 0.8, 0.1], [0.2, 0.5, -0.9], [0.7, -0.6, 0.3]])
    waveform = {"type": "smooth", "rms": 1.0, "time_s": 3.0}
    source = {"type": "latent_source", "nT_per_unit": vectors.tolist(), "waveform_of": waveform}
    survey = survey_file(tmp_path, scenario(seed, source, {"type": "temperature_scale", "rms_nT": 0.3}))
    names = ["latent_source", "temperature_scale", "temperature_alignment"]
    found = magtensor.close_loop(survey, search=names)
    assert {a["error_model"] for a in found.verdict["adopted"]} == {"latent_source", "temperature_scale"}
