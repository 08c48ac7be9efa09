"""The delay of a fast channel's log, which no grid of lags finds: proposed by a cross-correlation, to a sample."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import linear_state, scenario, suspects, synthetic, verdict_of

from magtensor.loop.fitting.model import Record
from magtensor.loop.searching.delayed_logs import LONGEST, Delays, delayed
from magtensor.loop.searching.profiling import SCREENING_SAMPLES, Thinned, best_settings
from magtensor.registry import Registry

ALPHA = 0.05


def with_channel(record: Record, values: Any) -> Record:
    return replace(record, logged={"wind": values - values.mean(axis=0)}, units={"wind": "m/s"})


@pytest.mark.parametrize("sensors", [1, 3])
def test_what_is_explained_is_what_least_squares_explain(sensors: int) -> None:
    """Columns shifted by hand and fitted beside the fit's own freedom, for delays of either sign, across a gap."""
    rng = np.random.default_rng(sensors)
    there = np.delete(np.arange(400), slice(150, 190))
    bell = np.exp(-(((np.arange(400) - 200.0) / 90.0) ** 4))  # nothing happens near the ends
    course = bell * np.convolve(rng.standard_normal(420), np.ones(21) / 21, mode="valid")
    record = synthetic(sensors, 400, sensors).at(there)
    state = linear_state(with_channel(record, course[there]))
    delays = Delays(state.residual, state.excitation)
    assert delays.reach == int(LONGEST * 400)
    r = state.residual
    as_offsets, as_factors = delays.explained(course[None])
    for delay in (-20, -7, 0, 3, 20):
        moved = np.roll(course, delay)[there][r.samples]
        if r.across is not None:
            known, left = r.free_across, r.across
            ways = [moved[:, None], moved[:, None] * r.affine[:, :3]]
        else:
            assert r.along is not None
            known, left = r.free_along, r.along[:, None]
            outputs = state.excitation.output[r.samples, 0]
            ways = [moved[:, None] * r.gain, moved[:, None] * r.gain * outputs]
        for found, columns in zip((as_offsets, as_factors), ways, strict=True):
            alone = columns - known @ (known.T @ columns)
            basis = np.linalg.qr(alone)[0]
            assert found[delays.reach + delay] == pytest.approx(np.sum((basis.T @ left) ** 2), rel=1e-3, abs=1e-3)


def test_delays_in_noise_are_seldom_less_likely_than_they_should_be() -> None:
    """A channel that has to do with nothing, in white noise: a tenth of the false alarms at most is of its delays."""
    model = Registry.load().find("error_model", "channel_response")
    least, proposed = [], []
    for seed in range(40):
        rng = np.random.default_rng(1000 + seed)
        record = with_channel(synthetic(seed, 600, 2), rng.standard_normal(600))
        state = linear_state(record)
        few = Thinned.of(state, SCREENING_SAMPLES)
        delays = Delays(state.residual, state.excitation)
        late, tests = delayed(model, [{"channel": "wind", "power": 1, "lag_s": 0.0}], delays, ALPHA)
        assert 20.0 < tests <= 2 * delays.reach + 1  # every sample of white noise is a test of its own
        scores = [few.white(few.terms(model, settings, {})) for settings in late]  # type: ignore[arg-type]
        least.append(min(1.0, tests * float(np.exp(-max(scores)))))
        proposed += [p for p in best_settings(model, state, few, delays, {}, ALPHA) if p.kind == "delayed"]
    found = np.array(least)
    assert np.mean(found < 0.1) < 0.35  # Sidak for two ways, 0.19, and three standard deviations of it
    assert np.mean(found < 0.5) > 0.1  # and the correction is no larger than it has to be
    assert len(proposed) <= 2  # of 40: ten times as unlikely as the best of all others, all delays counted


LATE = 23  # samples of half a second


def moved(path: Path, samples: int) -> None:
    """Write every value of the wind so many samples later, or sooner."""
    with h5py.File(path, "a") as file:
        logged = file["channels/wind"] if "channels" in file else file["wind"]
        at = np.clip(np.arange(len(logged)) - samples, 0, len(logged) - 1)
        logged[:] = logged[:][at]


@pytest.mark.long
@pytest.mark.parametrize(("samples", "power", "lag_s"), [(LATE, 2, -11.5), (-LATE, 1, 11.5)])
def test_a_gusty_wind_logged_at_another_time_is_found(samples: int, power: int, lag_s: float, tmp_path: Path) -> None:
    effect = {"type": "channel_response", "channel": "wind", "power": power, "rms_nT": 1.0}
    wind = {"type": "smooth", "mean": 0.0, "rms": 2.0, "time_s": 2.0, "units": "m/s", "log_noise": 0.002}
    survey = scenario(41, effect)
    survey["channels"] = survey["channels"] | {"wind": wind}
    told = verdict_of(
        tmp_path,
        survey,
        lambda path: moved(path, samples),
        ["channel_response", "current_field", "offset_drift", "sampling_lag"],
    )
    (adopted,) = told["adopted"]
    assert adopted["error_model"] == "channel_response", suspects(told)
    assert adopted["settings"]["channel"] == "wind" and adopted["settings"]["power"] == power
    assert adopted["settings"]["lag_s"] == pytest.approx(lag_s, abs=0.05) and adopted["settings"]["delayed"]
    # the log tells nothing of its last seconds, which were among the blocks held out when it was found
    assert adopted["evidence"]["held_out_rms_after_nT"] < 1.2 * told["noise_floor_nT"]
