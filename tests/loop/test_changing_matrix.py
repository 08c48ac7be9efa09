"""A sensor's matrix that is not constant is told, with the sensor and what it goes with; slow noise is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, linear_state, synthetic

from magtensor.loop.fitting.model import Fitting, Record
from magtensor.loop.remainder.changing_matrix import SLOW, changing_matrices, changing_words
from magtensor.loop.searching.search import search
from magtensor.loop.searching.unexplained import NOISE, unexplained
from magtensor.registry import Registry

ALPHA = 0.001


def with_channels(record: Record, **channels: Array) -> Record:
    """The record with logged channels, their origins taken off."""
    origins = {name: np.asarray(values.mean(axis=0)) for name, values in channels.items()}
    logged = {name: values - origins[name] for name, values in channels.items()}
    return replace(record, logged=logged, origins=origins, units=dict.fromkeys(channels, "1"))


def turned(record: Record, number: int, angle: Array) -> Record:
    """The record with one sensor's mount turned about a fixed axis by an angle (N,) rad."""
    axis = np.array([0.6, -0.5, 0.62])
    axis /= np.linalg.norm(axis)
    own = record.raw[:, number]
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    raw = record.raw.copy()
    raw[:, number] = c * own + s * np.cross(axis, own) + (1 - c) * (own @ axis)[:, None] * axis
    return replace(record, raw=raw)


def creep(samples: int) -> Array:
    """(N,) a mount that creeps and comes to rest, of mean 0 and rms 1."""
    w = -np.exp(-np.arange(samples) / (0.3 * samples))
    return (w - w.mean()) / w.std()


def warmth(rng: np.random.Generator, samples: int) -> Array:
    """(N,) a temperature that wanders slowly, of mean 0 and rms 1."""
    bell = np.exp(-0.5 * (np.arange(-300, 301) / 100.0) ** 2)
    w = np.convolve(rng.standard_normal(samples + 600), bell, mode="valid")
    return (w - w.mean()) / w.std()


def pump(rng: np.random.Generator, samples: int) -> Array:
    """(N,) 0 or 1, for some minute at a time."""
    return np.repeat(rng.permutation(np.arange(samples // 50) % 2), 50)[:samples].astype(float)


def slow_noise(rng: np.random.Generator, samples: int, sensors: int, exponent: float) -> Array:
    """(N, S, 3) nT of 1/f or random-walk noise, every axis's own, of every sensor's own strength."""
    frequency = np.maximum(np.fft.rfftfreq(2 * samples), 0.5 / samples)[:, None, None]
    corner = np.geomspace(0.003, 0.3, sensors)[:, None]
    spectrum = np.fft.rfft(rng.standard_normal((2 * samples, sensors, 3)), axis=0)
    return np.fft.irfft(spectrum * (corner / frequency) ** (exponent / 2.0), axis=0)[:samples]


def test_a_mount_that_creeps_is_told_with_its_sensor_and_size() -> None:
    record = synthetic(3, turning_s=3.0)
    disturbed = turned(record, 2, 4e-5 * creep(1200))
    (found,) = changing_matrices(linear_state(disturbed), ALPHA)
    assert found.sensors == ("S3",)
    (words,) = changing_words([found])
    assert words.endswith("changes with time: C of S3 is not constant")
    # four alike sensors show three quarters of what one adds, spread over nine contrasts and |b| - F
    added = np.sum((disturbed.raw - record.raw) ** 2) / len(record.raw)
    assert found.rms == pytest.approx(np.sqrt(0.75 * added / 10.0), rel=0.1)


def test_a_mount_that_turns_with_temperature_is_told_with_the_channel() -> None:
    rng = np.random.default_rng(5)
    w = warmth(rng, 1200)
    record = with_channels(synthetic(5, turning_s=3.0), temperature=20.0 + w, current_pump=pump(rng, 1200))
    (found,) = changing_matrices(linear_state(turned(record, 1, 2e-5 * w)), ALPHA)
    assert found.sensors == ("S2",) and found.waveform == "temperature"


def test_of_a_channel_for_each_sensor_its_own_counts() -> None:
    rng = np.random.default_rng(6)
    each = np.column_stack([warmth(rng, 1200) for _ in range(4)])
    record = with_channels(synthetic(6, turning_s=3.0), temperature=20.0 + each)
    (found,) = changing_matrices(linear_state(turned(record, 3, 2e-5 * each[:, 3])), ALPHA)
    assert found.sensors == ("S4",) and found.waveform == "temperature"


def test_no_name_of_a_channel_is_in_the_way() -> None:
    """Channels are of any name: one of them hides none of the slow courses of time that nobody logged."""
    rng = np.random.default_rng(6)
    logged = {name: rng.standard_normal(1200) for name in ("cosines", "time", "jump", "the field")}
    disturbed = with_channels(turned(synthetic(3, turning_s=3.0), 2, 4e-5 * creep(1200)), **logged)
    (found,) = changing_matrices(linear_state(disturbed), ALPHA)
    assert found.waveform == SLOW and "changes with time" in changing_words([found])[0]


def test_a_neighbour_that_is_heard_while_a_pump_runs() -> None:
    rng = np.random.default_rng(7)
    on = pump(rng, 1200)
    record = with_channels(synthetic(7, turning_s=3.0), temperature=warmth(rng, 1200), current_pump=1.8 * on)
    heard = record.raw[:, 0] @ (2e-5 * rng.standard_normal((3, 3)))
    raw = record.raw.copy()
    raw[:, 1] += on[:, None] * heard
    (found,) = changing_matrices(linear_state(replace(record, raw=raw)), ALPHA)
    assert found.sensors == ("S2",) and found.waveform == "current_pump"


def test_two_sensors_of_five_each_in_its_own_way() -> None:
    record = synthetic(8, sensors=5, turning_s=3.0)
    w = warmth(np.random.default_rng(8), 1200)
    disturbed = turned(turned(record, 0, 6e-5 * creep(1200)), 3, 4e-5 * w)
    found = changing_matrices(linear_state(with_channels(disturbed, temperature=w)), ALPHA)
    assert {(one.sensors, one.waveform) for one in found} == {(("S1",), SLOW), (("S4",), "temperature")}
    assert len(changing_words(found)) == 2


def test_of_sensors_that_change_with_the_same_one_sentence_is_said() -> None:
    record = synthetic(3, turning_s=3.0)
    disturbed = turned(turned(record, 2, 4e-5 * creep(1200)), 0, 3e-5 * creep(1200))
    found = changing_matrices(linear_state(disturbed), ALPHA)
    assert [one.sensors for one in found] == [("S3",), ("S1",)]
    (words,) = changing_words(found)
    assert words.endswith(f"C of S3 is not constant, nor is that of S1 ({found[1].rms:.3g} nT rms)")


def test_of_two_sensors_either_may_have_turned() -> None:
    """Only their difference is seen, and a turn leaves |b| as it is."""
    disturbed = turned(synthetic(9, sensors=2, turning_s=3.0), 0, 4e-5 * creep(1200))
    (found,) = changing_matrices(linear_state(disturbed), ALPHA)
    assert set(found.sensors) == {"S1", "S2"}
    assert " or " in found.whose


@pytest.mark.parametrize("exponent", [1.0, 2.0])
@pytest.mark.parametrize("turning_s", [0.0, 3.0, 20.0])
def test_slow_noise_is_no_change_of_a_matrix(exponent: float, turning_s: float) -> None:
    """Six times five surveys, each told by chance once in a thousand."""
    for seed in range(5):
        rng = np.random.default_rng(100 + seed)
        noise = slow_noise(rng, 1200, 4, exponent)
        record = synthetic(100 + seed, added=noise, turning_s=turning_s)
        record = with_channels(record, temperature=warmth(rng, 1200), current_pump=pump(rng, 1200))
        assert not changing_matrices(linear_state(record), ALPHA), seed


@pytest.mark.parametrize("sensors", [1, 2])
def test_a_base_station_that_drifts_is_no_change_of_a_matrix(sensors: int) -> None:
    for seed in range(6):
        rng = np.random.default_rng(300 + seed)
        record = synthetic(300 + seed, sensors=sensors)
        assert record.total_field is not None
        walk = np.cumsum(0.05 * rng.standard_normal(1200)) + 3.0 * creep(1200)
        disturbed = replace(record, total_field=record.total_field + walk)
        assert not changing_matrices(linear_state(disturbed), ALPHA), seed


def test_a_survey_of_a_few_postures_is_not_asked() -> None:
    assert not changing_matrices(linear_state(turned(synthetic(4, samples=60), 2, 4e-5 * creep(60))), ALPHA)


def test_the_verdict_says_so() -> None:
    record = synthetic(3, turning_s=3.0)
    clean, disturbed = (
        unexplained(search(each, [], Fitting()), each) for each in (record, turned(record, 2, 4e-5 * creep(1200)))
    )
    assert not clean["present"] and clean["description"] == NOISE
    assert disturbed["present"] and "C of S3 is not constant" in disturbed["description"]


@pytest.mark.parametrize("jumps", [False, True])
def test_a_mount_that_turns_with_temperature_has_not_jumped(jumps: bool) -> None:
    rng = np.random.default_rng(16)
    warm = warmth(rng, 1200)
    angle = np.where(np.arange(1200) > 700, 2e-5, -2e-5) if jumps else 4e-5 * warm
    record = with_channels(turned(synthetic(16, turning_s=3.0), 1, angle), temperature=warm)
    found = search(record, [Registry.load().find("error_model", "turn_step")], Fitting())
    assert [a.name for a in found.last.adopted] == ["turn_step"] * jumps
    told = unexplained(found, record)
    assert ("C of S2 is not constant" in told["description"]) is not jumps
    assert any("C of S2 going with temperature" in why for s in found.steps for why in s.refused.values()) is not jumps
