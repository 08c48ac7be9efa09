"""A tone that all sensors see as one vector shows in |b| - F alone, and there the platform's turning spreads it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import BASE, adopted_names, linear_state, lines_left, loaded, scenario, survey_file, verdict_of

import magtensor

TONE_HZ = 0.2331
TILTS = {"type": "limited_tilt", "duration_s": 1200.0, "tilt_deg": 25.0}
ONE = BASE["instrument"] | {"array": {"positions_m": [[0.0, 0.0, 0.0]], "names": ["S1"]}}


def hum(path: Path, phase: float = 0.7) -> None:
    """The field of a coil far off, fixed to the platform, as each sensor reads it."""
    with h5py.File(path, "a") as file:
        tone = np.sin(2.0 * np.pi * TONE_HZ * (file["time"][:] - file["time"][0]) + phase)
        file["b_raw"][:] = file["b_raw"][:] + tone[:, None, None] * (file["truth/matrix"][:] @ [0.5, -0.4, 0.3])


def hum_at_the_station(path: Path) -> None:
    """A tone of the base station alone, slow enough for its readings."""
    with h5py.File(path, "a") as file:
        file["reference/total_field"][:] += 0.4 * np.sin(2.0 * np.pi * 0.0431 * file["reference/time"][:])


def told(folder: Path, change: Any, **sections: Any) -> dict[str, Any]:
    return verdict_of(folder, scenario(17, **sections), change, ["periodic_interference", "reference_drift"])


TUMBLING: Any = pytest.param({}, marks=pytest.mark.long)


@pytest.mark.parametrize("sections", [TUMBLING, {"motion": TILTS}, {"instrument": ONE}])
def test_one_vector_of_a_tone_is_a_tone(sections: dict[str, Any], tmp_path: Path) -> None:
    found = told(tmp_path, hum, **sections)
    (adopted,) = found["adopted"]
    assert adopted["error_model"] == "periodic_interference"
    assert adopted["settings"]["frequency_Hz"] == pytest.approx(TONE_HZ, abs=2e-5)
    cosines = [c for c in adopted["coefficients"] if c["name"].startswith("cos")]
    sines = [c for c in adopted["coefficients"] if c["name"].startswith("sin")]
    sizes = np.hypot([c["value"] for c in cosines], [c["value"] for c in sines]).reshape(-1, 3)
    stds = np.array([max(c["std"], s["std"]) for c, s in zip(cosines, sines, strict=True)]).reshape(-1, 3)
    assert np.all(np.abs(sizes - [0.5, 0.4, 0.3]) < 5.0 * stds + 0.02)
    assert not found["unexplained"]["present"]


@pytest.mark.parametrize(
    "sections", [TUMBLING, {"motion": TILTS}, {"instrument": ONE}, {"motion": TILTS, "instrument": ONE}]
)
def test_a_tone_of_the_base_station_is_none_of_the_sensors(sections: dict[str, Any], tmp_path: Path) -> None:
    found = told(tmp_path, hum_at_the_station, **sections)
    assert "periodic_interference" not in adopted_names(found)


def test_the_line_is_that_of_the_tone_and_not_of_its_sidebands(tmp_path: Path) -> None:
    lines = lines_left(loaded(tmp_path, scenario(17), hum))
    assert lines[0][0] == pytest.approx(TONE_HZ, abs=1.0 / 1200.0) and lines[0][2] < 1e-10
    expected = np.sqrt(0.5**2 + 0.4**2 + 0.3**2) / np.sqrt(3.0) / np.sqrt(2.0)  # along a field that turns anywhere
    assert lines[0][1] == pytest.approx(expected, rel=0.2)


def test_a_drift_of_the_base_station_has_no_lines(tmp_path: Path) -> None:
    def drifting(path: Path) -> None:
        with h5py.File(path, "a") as file:
            walk = np.cumsum(np.random.default_rng(3).standard_normal(len(file["reference/time"])))
            file["reference/total_field"][:] += 0.1 * walk

    record = loaded(tmp_path, scenario(17), drifting)
    assert linear_state(record).residual.along is not None
    assert all(p > 0.01 for *_, p in lines_left(record))


def test_a_phase_that_the_sensors_do_not_show_is_not_made_up(tmp_path: Path) -> None:
    """What all sensors have alike they would have of a field as well: on another survey it is left in, and said so."""
    survey, other = (survey_file(tmp_path, scenario(s, motion=TILTS), f"{s}.h5") for s in (17, 18))
    hum(survey)
    hum(other, phase=2.1)
    found = magtensor.close_loop(survey, verify=other, search=["periodic_interference"]).verdict
    assert adopted_names(found) == {"periodic_interference"}
    verify = found["error"]["verify"]
    assert "does not show it, and its phase" in verify["not_taken_off"]
    before, after = (verify[when]["total_field_rms_nT"]["all"] for when in ("before", "after"))
    assert after < 1.01 * before
