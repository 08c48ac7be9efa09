"""What happens once has to be sharper than slow noise of any law: a base station that wanders beside the site has no
steps and no cars."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, linear_state, synthetic
from scipy.signal import lfilter

from magtensor.error_models.station import Station
from magtensor.loop.fitting.model import Record
from magtensor.loop.searching.gates import ALPHA, Candidate
from magtensor.loop.searching.outcome import why
from magtensor.loop.searching.rounds import with_lines
from magtensor.loop.searching.screening import candidates_of
from magtensor.registry import Registry

EVENTS = ("reference_step", "passing_source", "scale_step")
SAMPLES = 3000


def wandering(seed: int, tau_s: float, rms_nT: float) -> Array:
    """Two first-order lags after each other: smoother than noise of 1/f or 1/f^2, and steeper."""
    rng = np.random.default_rng(seed)
    course, keep = rng.standard_normal(SAMPLES + round(20 * tau_s)), np.exp(-1.0 / tau_s)
    course = lfilter([(1.0 - keep) ** 2], [1.0, -2.0 * keep, keep**2], course)
    course = course[-SAMPLES:] - course[-SAMPLES:].mean()
    out: Array = rms_nT * course / course.std()
    return out


def beside_a_base_station_with(error: Array, seed: int) -> Record:
    record = synthetic(seed, SAMPLES, turning_s=4.0, noise_nT=0.05)
    assert record.total_field is not None
    return replace(record, total_field=record.total_field + error, quiet_field=record.total_field + error)


def candidates(record: Record) -> list[Candidate]:
    registry = Registry.load()
    models = [registry.find("error_model", name) for name in EVENTS]
    return candidates_of(with_lines(linear_state(record), record), models, {}, ALPHA)


@pytest.mark.long
def test_a_base_station_that_wanders_has_no_events() -> None:
    """In noise of 1/f and 1/f^2 some of its bumps would be impossible; in noise of its own spectrum none is."""
    impossible = 0
    for seed in range(3, 6):
        for found in candidates(beside_a_base_station_with(wandering(seed, 30.0, 0.3), seed)):
            impossible += found.adjusted_null_p < ALPHA
            assert found.adjusted_p > ALPHA, found.model
            assert not found.passes
    assert impossible


def test_what_is_no_sharper_than_slow_noise_is_not_significant() -> None:
    """However unlikely it is in noise of the law that the residual's colour follows."""
    step = np.where(np.arange(SAMPLES) < 1800.5, 0.0, 0.5)
    found = candidates(beside_a_base_station_with(step, 3))[0]
    assert found.passes and found.adjusted_null_p < 0.02 * ALPHA
    assert "each sensor's own spectrum" in why(found, None)
    blunt = replace(found, adjusted_p=ALPHA, assessment=replace(found.assessment, p=1e-4), tried=1.0)
    assert not blunt.significant and not blunt.predicts  # so that it stands for nothing else that passes either
    assert "not significant" in why(blunt, None)


@pytest.mark.parametrize("step_nT", [1.0, 20.0])
def test_a_step_of_the_base_station_stands_out_of_that_wandering(step_nT: float) -> None:
    step = np.where(np.arange(SAMPLES) < 1800.5, 0.0, step_nT)
    found = {c.model.name: c for c in candidates(beside_a_base_station_with(step + wandering(3, 300.0, 0.1), 3))}
    assert found["reference_step"].passes
    assert found["reference_step"].model.settings["time_s"] == pytest.approx(1800.5, abs=5.0)


def test_a_step_of_the_base_station_is_found_between_any_two_of_its_readings() -> None:
    """Which are 30 s apart, where the times tried are 49 s apart: next to the right two it explains hardly anything, so
    that no way leads there."""
    read = np.arange(-60.0, SAMPLES + 60.0, 30.0)
    record = beside_a_base_station_with(np.zeros(SAMPLES), 5)
    model = Registry.load().find("error_model", "reference_step")
    for moment in [*np.arange(411.0, 1100.0, 67.0), 1014.0]:
        known = np.interp(read, record.time, np.asarray(record.total_field))
        station = Station(read, known + (read >= moment), "pchip")
        field = station.at(record.time)
        state = linear_state(replace(record, total_field=field, quiet_field=field, station=station))
        [found] = candidates_of(state, [model], {}, ALPHA)
        last = 30.0 * np.ceil(moment / 30.0)
        assert found.passes and last - 30.0 < found.model.settings["time_s"] <= last, moment


def test_two_steps_stand_out_one_after_the_other() -> None:
    time = np.arange(SAMPLES)
    steps = np.where(time < 900.5, 0.0, 3.0) - np.where(time < 2100.5, 0.0, 3.0)
    found = {c.model.name: c for c in candidates(beside_a_base_station_with(steps, 4))}
    assert found["reference_step"].adjusted_p < ALPHA
