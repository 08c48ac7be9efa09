"""Rows that are means over some time hold a field that is too short where it turns quickly: told, with the time."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import xarray as xr
from loop_cases import scenario, survey_file

import magtensor

PER_ROW = 4


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
