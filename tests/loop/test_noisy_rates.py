"""Rates of change of a noisy magnetometer are noisy themselves: what two models of a delay differ by is noise then, and
no fit may follow it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cases import BASE, Array, scenario, synthetic, verdict_of

from magtensor.error_models.terms import joined
from magtensor.loop.evidence.assessment import estimated
from magtensor.loop.fitting.model import Adopted, Fitting, Record
from magtensor.loop.fitting.refit import joint_state
from magtensor.registry import Registry

NOISE_NT = (150.0, 550.0)
LATE_S = ((0.0, 0.0, 0.0), (0.012, 0.009, 0.004))
RATE_HZ, SAMPLES = 10.0, 6000
SLOWLY = {"type": "tumbling", "duration_s": 500.0, "rate_rms_deg_s": 8.0, "rate_time_s": 3.0}
EARTH_NT = np.array([21_000.0, 1_500.0, 47_500.0])


def hanging(time: Array) -> Array:
    """(N, 3) nT, the field in a payload that spins about its cord at a changing rate, and swings by 15 degrees."""
    spin = 0.5 * time + 3.0 * np.sin(time / 40.0) + 0.8 * np.sin(time / 7.0)
    pitch, roll = np.radians(15.0) * np.sin(0.61 * time), np.radians(15.0) * np.sin(0.47 * time + 1.0)
    x = np.cos(spin) * EARTH_NT[0] + np.sin(spin) * EARTH_NT[1]
    y = -np.sin(spin) * EARTH_NT[0] + np.cos(spin) * EARTH_NT[1]
    x, z = np.cos(pitch) * x - np.sin(pitch) * EARTH_NT[2], np.sin(pitch) * x + np.cos(pitch) * EARTH_NT[2]
    y, z = np.cos(roll) * y + np.sin(roll) * z, -np.sin(roll) * y + np.cos(roll) * z
    return np.column_stack([x, y, z])


def two_chips(noise_nT: tuple[float, float], seed: int = 3) -> Record:
    """Two magnetometers on that payload, the axes of the second late."""
    rng, instrument = np.random.default_rng(seed), np.random.default_rng(1)
    time = np.arange(SAMPLES) / RATE_HZ
    seen = np.stack(
        [np.column_stack([hanging(time - axis)[:, i] for i, axis in enumerate(late)]) for late in LATE_S], axis=1
    )
    forward = np.eye(3) + 0.02 * instrument.standard_normal((2, 3, 3))
    raw = np.einsum("sij,nsj->nsi", forward, seen) + 300.0 * instrument.standard_normal((2, 3))
    raw = raw + np.array(noise_nT)[:, None] * rng.standard_normal(raw.shape)
    total = np.full(SAMPLES, float(np.linalg.norm(EARTH_NT)))
    base = synthetic(1, samples=SAMPLES, sensors=2)
    return replace(base, time=time, raw=raw, total_field=total, quiet_field=total)


def models() -> list[Adopted]:
    registry = Registry.load()
    return [
        Adopted(registry.find("error_model", "sampling_lag"), {"per_axis": False}),
        Adopted(registry.find("error_model", "eddy_current"), {"tau_s": 0.0013}),
    ]


def test_a_fit_does_not_follow_what_two_models_of_a_delay_differ_by() -> None:
    """`eddy_current` contains `sampling_lag` but for what its time constant, a hundredth of the sampling interval, does
    to the noise of the rates: the diagonal of both together is the delay of each axis, less what both sensors share."""
    state = joint_state(two_chips(NOISE_NT), models(), Fitting())
    lag, eddy = state.theta
    diagonal = np.array([eddy[9 * s + 4 * i] for s in range(2) for i in range(3)]).reshape(2, 3)
    late = diagonal + np.column_stack([lag] * 3)
    assert np.abs(diagonal).max() < 0.02  # runs away by seconds where noise is followed
    np.testing.assert_allclose(late[1] - late[0], LATE_S[1], atol=0.002)


@pytest.mark.parametrize(("noise_nT", "hidden"), [(NOISE_NT, 1), ((0.15, 0.55), 0)])
def test_directions_are_hidden_by_the_noise_of_the_regressors_only(noise_nT: tuple[float, float], hidden: int) -> None:
    """The difference of the two models is hidden; with a thousandth of the noise it shows."""
    record = two_chips(noise_nT)
    state = joint_state(record, [], Fitting())
    terms = joined([m.terms(state.excitation) for m in models()]).at(state.residual.samples)
    quiet = replace(terms, noise=np.zeros_like(terms.noise))
    ranks = [estimated(state.residual, t, state.colours).rank for t in (terms, quiet)]
    assert ranks[1] - ranks[0] == hidden


def test_the_noise_in_a_regressor_is_what_another_draw_of_the_noise_changes() -> None:
    """Half of the variance of the difference between two recordings of the same motion; of the output itself, too."""
    seen = [joint_state(two_chips(NOISE_NT, seed), [], Fitting()) for seed in (3, 4)]
    registry = Registry.load()
    for name, settings in (("sampling_lag", {"per_axis": False}), ("nonlinearity_quadratic", {})):
        model = Adopted(registry.find("error_model", name), settings)
        first, other = (model.terms(state.excitation) for state in seen)
        differ = np.mean((first.series - other.series) ** 2, axis=0) / 2.0 / first.series.var(axis=0)
        np.testing.assert_allclose(first.noise, differ, rtol=0.2)
        assert 1e-6 < differ.min() < differ.max() < 0.1


@pytest.mark.parametrize(
    ("noise_nT", "motion"),
    [
        ((330.0, 17.0), {"type": "limited_tilt", "duration_s": 500.0}),
        pytest.param((21.0, 210.0, 17.0, 66.0), SLOWLY, marks=pytest.mark.long),
        pytest.param((260.0, 170.0, 11.0), SLOWLY, marks=pytest.mark.long),
    ],
)
def test_nothing_is_left_of_sensors_as_unequal_as_they_come(
    tmp_path: Path, noise_nT: tuple[float, ...], motion: dict[str, Any]
) -> None:
    """Ten rows a second of an array that turns slowly: the field moves by less than the noise of the worst."""
    places = np.random.default_rng(2).normal(scale=0.4, size=(len(noise_nT), 3)).round(2).tolist()
    instrument = BASE["instrument"] | {
        "array": {"positions_m": places},
        "noise": {"white_sd_nT": [[noise] * 3 for noise in noise_nT]},
    }
    told = verdict_of(tmp_path, scenario(11, instrument=instrument, motion=motion, rate_Hz=10.0))
    assert not told["adopted"] and not told["unexplained"]["present"]
    assert told["noise_floor_nT"] == pytest.approx(np.sqrt(np.mean(np.square(noise_nT))), rel=0.1)
