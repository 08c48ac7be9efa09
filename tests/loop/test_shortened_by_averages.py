"""Rows that are means over some time hold a field that is too short where it turns: found, or told with the time."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from loop_cases import scenario, survey_file

import magtensor
from magtensor.closed_loop import ClosedLoop
from magtensor.simulate import simulate, write
from magtensor.simulate.run import Simulated

PER_ROW = 4
RIVALS = (
    "averaging", "sampling_lag", "bandwidth", "eddy_current", "viscous_magnetisation", "clock_drift", "hysteresis",
    "nonlinearity_cubic", "temperature_offset", "temperature_scale", "temperature_rate",
)  # fmt: skip
TURNS = RIVALS[:4]


@pytest.mark.parametrize("averaged", [True, False])
def test_averages(tmp_path: Path, averaged: bool) -> None:
    survey = scenario(41, rate_Hz=40.0)
    survey["motion"] = survey["motion"] | {"duration_s": 300.0, "rate_rms_deg_s": 40.0, "rate_time_s": 2.0}
    groups = dict(xr.open_groups(survey_file(tmp_path, survey), decode_times=False))
    rows = groups["/"][["b_raw", "position"]].coarsen(time=PER_ROW, boundary="trim")
    raw = groups["/"]["b_raw"]
    means = rows.mean() if averaged else groups["/"][["b_raw", "position"]].isel(time=slice(0, None, PER_ROW))
    means["b_raw"].attrs, means["position"].attrs = raw.attrs, groups["/"]["position"].attrs
    means["time"].attrs = groups["/"]["time"].attrs
    groups["/"] = means
    found = magtensor.close_loop({n: groups[n] for n in ("/", "/reference")}, search=["sampling_lag", "bandwidth"])
    told = re.search(r"as if every row were the mean over ([\d.]+) s", found.verdict["unexplained"]["description"])
    assert (told is not None) == averaged
    assert told is None or float(told[1]) == pytest.approx(PER_ROW / 40.0, rel=0.1)
    assert found.verdict["adopted"] == []


@pytest.mark.long
@pytest.mark.parametrize("also", [[], [{"type": "temperature_offset", "rms_nT": 1.0, "lag_s": 60.0}]])
def test_the_time_of_the_mean_is_found_and_taken_off_another_survey(
    tmp_path: Path, also: list[dict[str, object]]
) -> None:
    """Beside what turning or the temperature does; means over a row of 0.1 s are up to 30 nT too short, 4 nT rms."""
    spread = 0.1**2 / 24.0
    mean = {"type": "averaging", "spread_s2": [spread] * 4}
    hand = {"type": "tumbling", "duration_s": 400.0, "rate_rms_deg_s": 40.0, "rate_time_s": 2.0}
    first = scenario(41, mean, *also, rate_Hz=10.0, motion=hand)
    true = simulate(scenario(42, mean, rate_Hz=10.0, motion=hand, truth=True))
    write(true, tmp_path / "second.h5")
    found = magtensor.close_loop(survey_file(tmp_path, first), search=RIVALS)
    adopted = {a["error_model"]: a for a in found.verdict["adopted"]}
    assert set(adopted) == {"averaging", *(str(e["type"]) for e in also)}
    assert adopted["averaging"]["coefficients"][0]["value"] == pytest.approx(spread, rel=0.02)
    assert not found.verdict["unexplained"]["present"], found.verdict["unexplained"]
    if not also:
        attributes, error = applied(found, tmp_path / "second.h5", true)
        assert "not_on_this_survey" not in attributes
        assert error < 0.2  # noise of 0.15; 4 nT if it were left
        bare = simulate(scenario(43, rate_Hz=10.0, motion=hand, truth=True))
        write(bare, tmp_path / "bare.h5")
        without_reference(tmp_path / "bare.h5", tmp_path / "nobody.h5")
        for file in ("bare.h5", "nobody.h5"):
            attributes, error = applied(found, tmp_path / file, bare)
            assert attributes["not_on_this_survey"] == "averaging"
            assert error < 0.2


@pytest.mark.long
def test_what_is_late_beside_it_makes_the_array_no_later(tmp_path: Path) -> None:
    """A filter of each axis would be both at once: late by what nobody measured, for its law to shorten as much."""
    spread = 0.05**2 / 24.0
    effects = (
        {"type": "averaging", "spread_s2": [spread] * 4},
        {"type": "sampling_lag", "rms_nT": 0.45, "per_axis": True},
    )
    hand = {"type": "limited_tilt", "duration_s": 250.0, "tilt_deg": 40.0}
    found = magtensor.close_loop(survey_file(tmp_path, scenario(44, *effects, rate_Hz=10.0, motion=hand)), search=TURNS)
    adopted = {a["error_model"]: a for a in found.verdict["adopted"]}
    late = next(a for a in found.verdict["adopted"] if a["error_model"] != "averaging")
    assert "sampling_lag" in (late["error_model"], *late["indistinguishable_from"])  # a filter of a ms is the same
    assert len(adopted) == 2
    lags = [c["value"] for c in late["coefficients"]]
    assert abs(np.mean(lags)) < 0.1 * np.std(lags)
    assert adopted["averaging"]["coefficients"][0]["value"] == pytest.approx(spread, rel=0.05)


def applied(found: ClosedLoop, path: Path, true: Simulated) -> tuple[dict[str, Any], float]:
    """Attributes of a survey's calibrated field, and the rms error of |b|, nT."""
    given = found.calibration.apply(path)["calibrated/b"]
    b = given.to_numpy()
    errors = np.linalg.norm(b, axis=2) - np.linalg.norm(true.truth.b, axis=-1).reshape(len(b), -1)
    return dict(given.attrs), float(np.sqrt(np.mean(errors**2)))


def without_reference(path: Path, out: Path) -> None:
    shutil.copy(path, out)
    with h5py.File(out, "r+") as file:
        del file["reference"]


def test_the_next_order_of_a_long_mean_is_no_error_of_the_base_station(tmp_path: Path) -> None:
    """The fourth rate of change, by half a per cent of what the second explains."""
    hand = {"type": "tumbling", "duration_s": 200.0, "rate_rms_deg_s": 40.0, "rate_time_s": 5.0}
    mean = {"type": "averaging", "spread_s2": [0.4**2 / 24.0] * 4}
    path = survey_file(tmp_path, scenario(61, mean, rate_Hz=10.0, motion=hand))
    told = magtensor.close_loop(path, search=["averaging"]).verdict
    assert [a["error_model"] for a in told["adopted"]] == ["averaging"]
    words = told["unexplained"]["description"]
    assert "of what averaging makes of it, whose law may leave as much" in words and "base station" not in words


def test_means_over_many_rows_are_taken_off(tmp_path: Path) -> None:
    """A file smoothed over 15 rows: second differences of neighbours, times the spread, would make more of their noise
    each time they are taken off. What the next order leaves is 3 T^4 / 5760 of the fourth rate of change."""
    hand = {"type": "tumbling", "duration_s": 150.0, "rate_rms_deg_s": 30.0, "rate_time_s": 5.0}
    mean = {"type": "averaging", "spread_s2": [0.75**2 / 24.0] * 4}
    found = magtensor.close_loop(survey_file(tmp_path, scenario(62, mean, rate_Hz=20.0, motion=hand)), search=TURNS)
    assert [a["error_model"] for a in found.verdict["adopted"]] == ["averaging"]
    assert found.verdict["adopted"][0]["coefficients"][0]["value"] == pytest.approx(0.75**2 / 24.0, rel=0.05)
    held_out = found.verdict["error"]["held_out"]
    before, after = (held_out[when]["total_field_rms_nT"]["all"] for when in ("before", "after"))
    assert before > 100.0 and after < 0.03 * before
