"""The measured recordings beside the project, through the survey sections of their recipes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from magtensor.recipe.source import load_yaml
from magtensor.survey.model import Survey
from magtensor.survey.sections import SurveySection
from magtensor.survey.source import Source
from magtensor_stages import detrend_diurnal, load

RECIPES = Path(__file__).parents[2] / "recipes" / "measured"
pytestmark = pytest.mark.measured


@pytest.fixture
def measured(registered: dict[str, Any]) -> Any:
    """Load the recording a recipe names, with the recipe's own options of `load` (none of them for the whole)."""

    def run(name: str, *, whole: bool = False, **changes: Any) -> Survey:
        recipe = load_yaml(RECIPES / f"{name}.yaml").value
        section = SurveySection.model_validate_json(json.dumps({**recipe["survey"], **changes}))
        folder = (RECIPES / section.names[0]).parent
        if not folder.is_dir():
            pytest.skip(f"the recordings of {name} are not here")
        given = next(iter(recipe["stages"]))
        options = given["load"] if isinstance(given, dict) and not whole else {}
        options = {k: tuple(v) if isinstance(v, list) else v for k, v in options.items()}
        return load(Survey(xr.DataTree(), source=Source(section, RECIPES, registered)), **options)

    return run


def magnitudes(survey: Survey) -> np.ndarray:
    """(N, S) nT, good samples."""
    return np.linalg.norm(survey.values("b_raw"), axis=2)[survey.good]


def test_balloon(measured: Any) -> None:
    survey = measured("balloon", whole=True)
    assert survey.sensors == ["RM3100", "AK09916"]
    assert len(survey.time) == 43_470
    assert survey["time"].attrs["rate_Hz"] == pytest.approx(9.5, abs=0.1)
    assert survey["time"].attrs["units"] == "seconds since 2025-02-22T00:00:00Z"
    assert survey["b_raw"].attrs["quantisation_nT"] == pytest.approx([1000 / 75, 150.0], rel=1e-6)
    bad = ~survey.good_by_sensor
    assert (bad.sum(axis=0) == [6, 0]).all(), "the corrupt rows, and no others"
    assert magnitudes(survey).max() < 105_000, "the AK09916 sits 60 uT off centre"
    temperature = survey.values("temperature")
    assert -47 < temperature.min() < temperature.max() < 8
    assert np.abs(np.diff(temperature, axis=0)).max() < 5, "the TMP102's register no longer wraps"
    # The payload turns and swings, but weighs what it weighs: the median specific force is one g.
    assert np.median(np.linalg.norm(survey.values("acceleration"), axis=1)) == pytest.approx(9.81, rel=0.03)
    total = np.asarray(detrend_diurnal(survey)["total_field"][1])
    assert total[0] == pytest.approx(53_000, abs=10)
    assert total[-1] == pytest.approx(53_000 * (6371.2 / (6371.2 + 31.0)) ** 3, abs=10), "31 km up"


def test_quadcopter(measured: Any) -> None:
    survey = measured("quadcopter")
    assert survey.sensors == ["external", "internal"]
    assert survey.time[-1] <= 145
    assert survey["time"].attrs["rate_Hz"] == pytest.approx(10, abs=0.1)
    assert survey.good.all()
    assert (np.abs(np.median(magnitudes(survey), axis=0) - 46_500) < 2_000).all()
    np.testing.assert_allclose(np.linalg.norm(survey.values("attitude"), axis=1), 1.0)
    assert survey.values("current_battery").max() > 10


def test_broad(measured: Any) -> None:
    survey = measured("broad")
    assert survey["time"].attrs["rate_Hz"] == pytest.approx(285.714, abs=0.001)
    assert survey["b_raw"].attrs["new_sample_share"] == pytest.approx([0.71], abs=0.01)
    assert survey.good.all(), "a magnetometer slower than the recording is not stuck"
    attitude = survey.values("attitude")
    known = np.isfinite(attitude).all(axis=1)
    assert (~known).sum() == 6824 // 4
    # Turned into the world frame the field points down and north, and gravity's reaction up: ENU it is.
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(attitude[known])
    world = turn.apply(survey.values("b_raw")[known, 0]).mean(axis=0)
    assert world[1] > 10_000
    assert world[2] < -35_000
    assert abs(world[0]) < 1_000
    np.testing.assert_allclose(turn.apply(survey.values("acceleration")[known]).mean(axis=0), [0, 0, 9.81], atol=0.05)
    assert set(survey.values("segment")) == {0, 1, 2}


@pytest.mark.parametrize("trial", ["32_disturbed_attached_magnet_1cm", "34_disturbed_attached_magnet_3cm"])
def test_broad_with_a_magnet_is_no_data_fault(measured: Any, trial: str) -> None:
    survey = measured("broad", file=f"../../../shared/data/broad/{trial}.hdf5")
    assert survey.good.mean() > 0.999


def test_boulder(measured: Any) -> None:
    survey = measured("boulder")
    assert len(survey.time) == 41_592
    assert survey["time"].attrs["rate_Hz"] == pytest.approx(1 / 60)
    assert survey["time"].attrs["units"] == "seconds since 2016-01-01T00:00:00Z"
    np.testing.assert_allclose(survey.values("b_raw")[0, 0], [20_735.93, -99.77, 47_370.21])
    given = detrend_diurnal(survey)
    off = magnitudes(survey)[:, 0] - np.asarray(given["total_field"][1])
    assert off.std() < 1.0, "variometer and scalar see the same variation"
    assert np.std(given["diurnal"][1]) > 5


def test_conrad(measured: Any) -> None:
    survey = measured("conrad")
    assert survey.sensors == ["FGE", "LEMI036"]
    assert survey.values("b_raw").shape == (86_400, 2, 3)
    assert survey.good.all()
    assert len(survey.values("reference/time")) == 86_391
    given = detrend_diurnal(survey)
    off = magnitudes(survey) - np.asarray(given["total_field"][1])[:, None]
    assert (off.std(axis=0) < 0.1).all()
    assert np.nanmax(given["total_field_std"][1]) < 0.05


def test_conrad_without_base_values_is_refused(measured: Any) -> None:
    sensors = {"FGE": {"from": ["x", "y", "z"], "units": "nT"}}
    with pytest.raises(Exception, match=r"sensor FGE: the median magnitude is 8\d\d\.?\d* nT.*\n.*base values"):
        measured("conrad", sensors=sensors)
