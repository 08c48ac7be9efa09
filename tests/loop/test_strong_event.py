"""A magnet as strong as the field lies on the platform for a while: no ellipsoid fits all samples together."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from loop_cases import scenario, survey_file
from numpy.typing import NDArray

import magtensor
from magtensor.calibration.another_centre import another_centre
from magtensor.errors import NotEnoughData

MAGNET = np.array([[9000.0, -4000, 60_000], [20_000, 15_000, -3000], [-8000, 2000, 13_000], [30_000, -30_000, 10_000]])
RIVALS = ("offset_step", "offset_while", "offset_drift", "passing_source")
SHORT = {"motion": scenario()["motion"] | {"duration_s": 600.0}}
FIELD = 49_500.0


def turning(count: int, seed: int) -> NDArray[np.float64]:
    """(N, 3) directions that follow each other, all round."""
    rng = np.random.default_rng(seed)
    v = np.cumsum(rng.standard_normal((count, 3)), axis=0)
    v -= v.mean(axis=0)
    out: NDArray[np.float64] = v / np.linalg.norm(v, axis=1, keepdims=True)
    return out


@pytest.mark.parametrize(("begin", "end"), [(700, 1500), (0, 900), (1300, 3000)])
def test_the_times_and_the_vector(begin: int, end: int) -> None:
    rng = np.random.default_rng(3)
    c = np.eye(3) + 0.03 * rng.standard_normal((3, 3))
    raw = FIELD * turning(3000, 1) @ c.T + 200.0 * rng.standard_normal(3) + 5.0 * rng.standard_normal((3000, 3))
    raw[begin:end] += MAGNET[0]
    found = another_centre(raw[:, None], np.full(3000, FIELD))
    assert found is not None
    first, last, sign = (end, 3000, -1.0) if begin == 0 else (begin, end, 1.0)  # what ends has begun before the survey
    assert abs(found.first - first) <= 1
    assert abs(found.end - last) <= 1
    assert found.moved[0] == pytest.approx(sign * MAGNET[0], abs=0.01 * FIELD)
    assert found.left[0] < 1e-3


def test_one_centre_is_not_two() -> None:
    """A clean sensor: what the times that suit its noise best explain of it is chance."""
    raw = FIELD * turning(3000, 2) + 5.0 * np.random.default_rng(4).standard_normal((3000, 3))
    found = another_centre(raw[:, None], np.full(3000, FIELD))
    assert found is not None
    assert found.left[0] > 0.9
    assert another_centre(raw[:500, None], np.full(500, FIELD)) is None


def beside_a_magnet(folder: Path, sensors: list[int], begin_s: float, end_s: float) -> dict[str, Any]:
    """A survey's groups."""
    groups = dict(xr.open_groups(survey_file(folder, scenario(11, **SHORT)), decode_times=False))
    survey = groups["/"].load()
    elapsed = survey["time"].to_numpy() - float(survey["time"][0])
    survey["b_raw"].to_numpy()[(elapsed >= begin_s) & (elapsed < end_s)] += MAGNET
    return {"/": survey.isel(sensor=sensors), "/reference": groups["/reference"]}


@pytest.mark.parametrize(
    ("sensors", "end_s"),
    [
        pytest.param([0], 400.0, marks=pytest.mark.long),
        pytest.param([0, 1, 2, 3], 400.0, marks=pytest.mark.long),
        pytest.param([0, 1, 2, 3], 700.0, marks=pytest.mark.long),
    ],
)
def test_it_is_named_and_the_calibration_is_as_good_as_without(
    tmp_path: Path, sensors: list[int], end_s: float
) -> None:
    survey = beside_a_magnet(tmp_path, sensors, 200.0, end_s)
    found = magtensor.close_loop(survey, search=RIVALS)
    (adopted,) = found.verdict["adopted"]
    lasting = end_s > 600.0
    assert adopted["error_model"] == ("offset_step" if lasting else "offset_while")
    assert adopted["settings"] == pytest.approx({"time_s": 200.0} | ({} if lasting else {"until_s": 400.0}), abs=0.5)
    vectors = np.array([c["value"] for c in adopted["coefficients"]]).reshape(-1, 3)
    assert vectors == pytest.approx(MAGNET[sensors], abs=0.5)
    error = found.verdict["error"]["held_out"]
    if len(sensors) == 1:
        assert error["before"]["total_field_rms_nT"]["all"] > 5000.0
    else:
        assert error["before"] is None  # no calibration without it brings the sensors to one field
    assert error["after"]["total_field_rms_nT"]["all"] < 0.2  # 0.15 nT of noise an axis, 0.1 nT of the base station's
    assert found.verdict["calibration"]["determined"]
    assert not found.verdict["unexplained"]["present"]


def test_without_leave_to_adopt_it_the_survey_is_refused(tmp_path: Path) -> None:
    survey = beside_a_magnet(tmp_path, [0], 200.0, 400.0)
    with pytest.raises(NotEnoughData, match="no ellipsoid comes nearer"):
        magtensor.close_loop(survey, search=RIVALS, most_effects=0)


@pytest.mark.parametrize(("missing", "kept"), [(0.03, True), (0.8, False)])
def test_an_attitude_that_is_missing_for_a_while(tmp_path: Path, missing: float, kept: bool) -> None:
    """A camera that loses its targets: what is between two of its readings stands in, or there is no attitude."""
    groups = dict(
        xr.open_groups(
            survey_file(tmp_path, scenario(12, logging={"attitude": True, "attitude_noise_deg": 0.1}, **SHORT)),
            decode_times=False,
        )
    )
    survey = groups["/"].load()
    count = survey.sizes["time"]
    survey["attitude"].to_numpy()[200 : 200 + int(missing * count)] = np.nan
    found = magtensor.close_loop(
        {"/": survey, "/reference": groups["/reference"]}, search=["site_gradient", "offset_drift"]
    )
    assert found.verdict["adopted"] == []
    lacking = {one["error_model"]: one["missing"] for one in found.verdict["not_tested"]}
    assert ("site_gradient" in lacking) is not kept
    assert ("attitude" in str(found.verdict["unexplained"]["description"])) is not kept
