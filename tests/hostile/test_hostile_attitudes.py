"""Motions from which no calibration can be made: refused by every method, with what is missing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import pytest
import yaml
from hostile_surveys import SCENARIO, true_field

from magtensor.cli import status_of

RECIPES = ("chi", "li", "joint")


def simulated(folder: Path, motion: dict[str, Any], noise: float = 0.5, rate: float = 2.0) -> Path:
    instrument = {**SCENARIO["instrument"], "noise": {"white_sd_nT": noise}}
    scenario = {**SCENARIO, "motion": motion, "instrument": instrument, "rate_Hz": rate}
    (folder / "scenario.yaml").write_text(yaml.safe_dump(scenario), encoding="utf-8")
    assert status_of(["simulate", str(folder / "scenario.yaml"), "--output", str(folder / "survey.nc")]) == 0
    return folder / "survey.nc"


@pytest.mark.parametrize(
    ("duration_s", "rate", "noise", "axis", "tilt"),
    [
        (250.0, 2.0, 0.5, [0.0, 0, 1], [20.0, 10, 0]),
        (250.0, 2.0, 0.0, [0.0, 0, 1], [20.0, 10, 0]),
        (250.0, 2.0, 0.0, [0.0, 0, 1], [0.0, 0, 0]),
        (250.0, 2.0, 3.0, [1.0, 0, 0], [0.0, 0, 0]),
        (10_000.0, 10.0, 0.5, [0.0, 0, 1], [20.0, 10, 0]),
        (10_000.0, 10.0, 0.0, [0.0, 0, 1], [20.0, 10, 0]),
    ],
)
def test_a_planar_rotation(
    tmp_path: Path, bench: Any, duration_s: float, rate: float, noise: float, axis: list[float], tilt: list[float]
) -> None:
    motion = {"type": "one_axis", "duration_s": duration_s, "axis": axis, "tilt_deg": tilt}
    survey = simulated(tmp_path, motion, noise, rate)
    for recipe in RECIPES:
        wrong = "the attitudes do not determine|never leave a plane"
        bench(recipe, survey).refused(r"survey\.nc", wrong, "about more than one axis")


@pytest.mark.parametrize("count", [3, 8, 9])
@pytest.mark.parametrize("recipe", RECIPES)
def test_too_few_postures(tmp_path: Path, bench: Any, count: int, recipe: str) -> None:
    survey = simulated(tmp_path, {"type": "random_attitudes", "count": count})
    bench(recipe, survey).refused(r"survey\.nc", f"{count} samples", "at least 10 samples")


@pytest.mark.parametrize("count", [3, 8])
@pytest.mark.parametrize("recipe", RECIPES)
def test_many_samples_of_few_postures(tmp_path: Path, bench: Any, count: int, recipe: str) -> None:
    """Resting twenty seconds in each makes samples, not attitudes."""
    survey = simulated(tmp_path, {"type": "postures", "random_count": count, "rest_s": 20.0, "turn_s": 5.0})
    bench(recipe, survey).refused(r"survey\.nc", "the attitudes do not determine", "largest cone without a sample")


@pytest.mark.parametrize("recipe", RECIPES)
def test_twelve_postures_are_enough(tmp_path: Path, bench: Any, recipe: str) -> None:
    """Nine parameters of each sensor from twelve scalars: an error of a few times the noise."""
    survey = simulated(tmp_path, {"type": "postures", "random_count": 12, "rest_s": 20.0, "turn_s": 5.0})
    outcome = bench(recipe, survey).succeeded()
    with h5py.File(survey) as file:
        time = file["time"][()]
    mean, difference, _ = outcome.error_against(true_field(survey), time)
    assert mean < 1.0
    assert difference < 1.0


def test_hardly_any_tilt(tmp_path: Path, bench: Any) -> None:
    """A fit that does not converge for want of attitudes does not blame the samples."""
    survey = simulated(tmp_path, {"type": "limited_tilt", "duration_s": 400.0, "tilt_deg": 1.0}, noise=1.0)
    bench("joint", survey).refused(
        "do not determine", "condition number", "largest cone without a sample", "a picture of"
    )
