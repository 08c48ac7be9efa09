"""What is adopted as an error is a small one: it amplifies no noise, can be taken off, has the form of its cause."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import BASE, adopted_names, linear_state, loaded, scenario, verdict_of

from magtensor.calibration.types import ArrayCalibration
from magtensor.errors import DataError
from magtensor.loop.correcting.correction import corrected_raw
from magtensor.loop.fitting.model import Adopted, Record, State
from magtensor.loop.searching.contribution import share_of_differences
from magtensor.loop.searching.keeping import MOST_OF_DIFFERENCES
from magtensor.registry import Registry
from magtensor.tensor.geometry import term_names


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return loaded(tmp_path_factory.mktemp("linear"), scenario(5, rate_Hz=0.5, logging={"attitude": True}))


@pytest.fixture(scope="module")
def state(record: Record) -> State:
    return linear_state(record)


def with_model(state: State, name: str, theta: Any, **settings: Any) -> State:
    model = Adopted(Registry.load().find("error_model", name), settings)
    return replace(state, adopted=(model,), theta=(np.asarray(theta, dtype=float),))


@pytest.mark.parametrize(("mm", "small"), [(2.0, True), (200.0, False)])
def test_positions_that_are_wrong_by_the_size_of_the_array_are_no_small_error(
    mm: float, small: bool, state: State
) -> None:
    """A shift by d sees d times the gradient that differences D between sensors half a baseline apart make: of a cross
    with arms a, x'(1) - x'(3) = 2 a g, so that the share is of the order of d / (2 a)."""
    shifts = np.zeros((3, 4))
    shifts[0] = mm, -mm, mm, -mm
    share = share_of_differences(with_model(state, "position_error", shifts.ravel()), 0)
    assert 0.1 * mm / 500.0 < share < 2.0 * mm / 500.0
    assert (share < MOST_OF_DIFFERENCES) == small
    assert share_of_differences(with_model(state, "nonlinearity_cubic", np.full(12, 1e4)), 0) == 0.0


@pytest.mark.parametrize(("cm3", "settles"), [(1.6, True), (-60000.0, False)])
def test_a_correction_that_grows_is_refused(cm3: float, settles: bool, record: Record, state: State) -> None:
    """A coil of 60 000 cm3 would make more of a difference between two sensors than there is."""
    calibration = ArrayCalibration(np.linalg.inv(state.fit.forward), state.fit.offset, np.eye(48), "")
    coils = with_model(state, "crosstalk", np.full(4, cm3))
    assert (share_of_differences(coils, 0) < MOST_OF_DIFFERENCES) == settles
    if settles:
        found = corrected_raw(record, calibration, coils.adopted, coils.theta)
        assert np.abs(found - record.raw).max() < 0.01  # the field is uniform
    else:
        with pytest.raises(DataError, match="crosstalk\\) cannot be taken off"):
            corrected_raw(record, calibration, coils.adopted, coils.theta)


@pytest.mark.parametrize("distance", [1.1, 2.0, 5.0])
def test_the_series_of_a_dipole_falls_off(distance: float, record: Record, state: State) -> None:
    """The derivatives of a dipole's potential at the array's centre, by central differences, are those of a source; the
    highest ones alone are not."""
    reach = float(np.linalg.norm(record.position, axis=1).max()) if record.position is not None else 0.0
    place, moment = distance * reach * np.array([0.48, -0.6, 0.64]), np.array([0.2, 0.9, -0.3])

    def potential(at: Any) -> float:
        r = at - place
        return float(moment @ r / np.linalg.norm(r) ** 3)

    h = 0.02 * reach

    def derivative(name: str) -> float:
        points, weights = [np.zeros(3)], [1.0]
        for axis in name:
            step = h * np.eye(3)["xyz".index(axis)]
            points = [p + s for p in points for s in (step, -step)]
            weights = [w * s / (2 * h) for w in weights for s in (1.0, -1.0)]
        return -sum(w * potential(p) for w, p in zip(weights, points, strict=True))

    names = [name for degree in (2, 3, 4) for name in term_names(degree)]
    theta = np.array([derivative(name) for name in names])
    falls_off = Registry.load().find("error_model", "fixed_source").agrees
    assert falls_off is not None and falls_off(state.excitation, {"degree": 4}, theta, 1.0)
    alone = np.where([len(name) == 4 for name in names], theta, 0.0)
    assert not falls_off(state.excitation, {"degree": 4}, alone, 1.0)


@pytest.mark.long
def test_a_kink_of_every_axis_is_no_source_and_no_error_of_positions(tmp_path: Path) -> None:
    """Every axis adds k |m|: its even part of fourth degree turns with the attitude as a source's might."""

    def kinked(path: Path) -> None:
        import h5py

        with h5py.File(path, "r+") as file:
            raw = file["b_raw"][...]
            size = np.random.default_rng(1).normal(0.0, 2.0, raw.shape[1:])
            file["b_raw"][...] = raw + size * np.abs(raw) / 30000.0

    motion = BASE["motion"] | {"duration_s": 600.0, "rate_rms_deg_s": 30.0}
    survey = scenario(1, rate_Hz=5.0, motion=motion, logging={"attitude": True})
    told = verdict_of(tmp_path, survey, kinked)
    assert adopted_names(told) <= {"nonlinearity_quadratic", "nonlinearity_cubic"}
    assert any(one["settings"]["bends"] for one in told["adopted"])
    assert not told["unexplained"]["present"], told["unexplained"]["description"]
    assert told["error"]["fit"]["total_field_rms_nT"]["all"] < 0.2  # 0.15 nT of noise an axis
