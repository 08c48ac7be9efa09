"""A source nobody logged: its test, its waveform, and what may not pass for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, linear_state, synthetic
from scipy.stats import kstest

from magtensor.calibration.types import ArrayCalibration
from magtensor.error_models.direction import attitude_series, curve_series
from magtensor.error_models.switching import two_levels
from magtensor.error_models.waveform import course_of, free_directions
from magtensor.loop.correcting.correction import corrected_raw, hidden_waveform
from magtensor.loop.evidence.factor import noise_alone, with_factor
from magtensor.loop.evidence.shared_waveform import ALPHA, second_factor, strongest
from magtensor.loop.fitting.model import Adopted, Fitting, Record
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.wandering import narrowed_to, of_sensors
from magtensor.loop.searching import latent
from magtensor.loop.searching.latent import of_every_sensor, shared_words, sought, tried_source
from magtensor.registry import Registry
from magtensor.tensor.geometry import array_design, standard_geometry

MODEL = Registry.load().find("error_model", "latent_source")


def plane(rng: np.random.Generator, sensors: int) -> Array:
    """Directions off the plane of nearly parallel sensors."""
    return free_directions(np.vstack([np.eye(3) + 0.03 * rng.standard_normal((3, 3)) for _ in range(sensors)]))


def own_noise(rng: np.random.Generator, samples: int, sensors: int) -> Array:
    """Noise of each sensor: its own level, its axes correlated."""
    mix = [np.eye(3) + 0.5 * rng.standard_normal((3, 3)) for _ in range(sensors)]
    levels = 10.0 ** rng.uniform(-0.3, 0.3, sensors)
    each = [v * rng.standard_normal((samples, 3)) @ m for v, m in zip(levels, mix, strict=True)]
    return np.concatenate(each, axis=1)


def by_sensor(sensors: int) -> list[np.ndarray]:
    return [np.arange(3 * s, 3 * s + 3) for s in range(sensors)]


@pytest.mark.parametrize("sensors", [3, 4])
def test_noise_of_single_sensors_is_no_common_factor(sensors: int) -> None:
    rng = np.random.default_rng(sensors)
    p = []
    for _ in range(60):
        basis = plane(rng, sensors)
        z = own_noise(rng, 200, sensors) @ basis
        p.append(np.exp(noise_alone(z.T @ z / 200, basis, by_sensor(sensors)).log_p(200)))
    assert kstest(p, "uniform").pvalue > 0.001


@pytest.mark.parametrize("times", [1, 5, 25])
def test_noise_that_grows_quieter_in_all_sensors_is_no_common_factor(times: int) -> None:
    """Where it is loud in all of them together, once or now and then, it tells as little as a shorter survey."""
    smallest = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        basis = plane(rng, 4)
        loud = np.where(np.arange(3000) % (3000 // times) < 900 // times, 3.0, 0.3)[:, None]
        smallest.append(strongest(own_noise(rng, 3000, 4) * loud @ basis, basis, by_sensor(4)).p)
    assert min(smallest) > 0.01 / len(smallest)


def test_a_source_that_comes_and_goes_tells_as_much_as_before() -> None:
    rng = np.random.default_rng(0)
    basis = plane(rng, 4)
    wave = np.repeat(rng.random(50) < 0.3, 60).astype(float) * (np.arange(3000) < 1500)
    z = (own_noise(rng, 3000, 4) + 0.4 * np.outer(wave, rng.standard_normal(12))) @ basis
    assert strongest(z, basis, by_sensor(4)).p < 1e-12


@pytest.mark.parametrize("loud_times", [1.0, 4.0])
def test_one_source_in_noise_that_is_loud_for_a_while_is_one(loud_times: float) -> None:
    """That noise makes what the sensors share vary as few samples would; a second source is one all the same."""
    strengths = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        basis = plane(rng, 4)
        loud = np.where(np.arange(3000) < 300, loud_times, 1.0)[:, None]
        waves = np.cumsum(rng.standard_normal((2, 3000)), axis=1)
        first, second = (w / w.std() for w in waves)
        z = own_noise(rng, 3000, 4) * loud + 3.0 * np.outer(first, rng.standard_normal(12))
        each = [z, z + 3.0 * np.outer(second, rng.standard_normal(12))]
        for whole in each:
            test = strongest(whole @ basis, basis, by_sensor(4))
            factors = with_factor(test.covariance, basis, by_sensor(4), test.alone)
            strengths.append(second_factor(test, basis, factors))
    one, two = np.reshape(strengths, (-1, 2)).T
    assert np.count_nonzero(one) <= 1  # one test in a thousand
    assert np.count_nonzero(two) >= 15


def test_a_factor_is_told_from_noise_and_its_direction_found() -> None:
    rng = np.random.default_rng(5)
    basis = plane(rng, 4)
    direction = rng.standard_normal(12)
    wave = rng.standard_normal(300)
    z = (own_noise(rng, 300, 4) + np.outer(wave, direction)) @ basis
    covariance = z.T @ z / 300
    alone = noise_alone(covariance, basis, by_sensor(4))
    found = with_factor(covariance, basis, by_sensor(4), alone)
    assert alone.log_p(300) < np.log(1e-6)
    assert found.log_p(300) > np.log(0.001)
    a, b = basis.T @ found.direction, basis.T @ direction
    assert abs(a @ b) / np.linalg.norm(a) / np.linalg.norm(b) > 0.95
    assert found.deviance < alone.deviance


@pytest.mark.parametrize("strength", [1e2, 1e4])
def test_a_factor_far_above_the_noise_leaves_no_second_one(strength: float) -> None:
    rng = np.random.default_rng(5)
    basis = plane(rng, 4)
    wave = np.sign(rng.standard_normal(300))
    z = (own_noise(rng, 300, 4) + strength * np.outer(wave, rng.standard_normal(12))) @ basis
    covariance = z.T @ z / 300
    found = with_factor(covariance, basis, by_sensor(4), noise_alone(covariance, basis, by_sensor(4)))
    assert found.log_p(300) > np.log(0.001)


def in_noise(signal: Array, strength: float, seed: int = 3) -> tuple[Array, Array, Array]:
    """Whitened outputs of four sensors with a source, the plane, and its vector; strength of the part off the plane."""
    rng = np.random.default_rng(seed)
    held = np.vstack([np.eye(3)] * 4)
    direction = rng.standard_normal(12)
    direction -= held @ np.linalg.lstsq(held, direction, rcond=None)[0]
    direction *= strength / np.linalg.norm(direction)
    return np.outer(signal, direction) + rng.standard_normal((len(signal), 12)), held, direction


def test_a_fast_source_is_known_as_well_as_one_sample_tells() -> None:
    signal = np.random.default_rng(1).standard_normal(4000)
    for strength in (0.5, 1.0, 3.0):
        y, held, direction = in_noise(signal, strength)
        course = course_of(y, held, direction)
        left = 1.0 / (1.0 + strength**2)  # of the Wiener filter for white signal in white noise of 1 / strength^2
        assert np.mean((course.values - signal) ** 2) == pytest.approx(left, rel=0.1)
        assert course.std**2 == pytest.approx(left, rel=0.15)
        assert course.rms == pytest.approx(1.0, abs=0.15)


def test_a_slow_source_is_known_better_than_one_sample_tells() -> None:
    signal = np.sqrt(2.0) * np.sin(np.arange(4000) / 90.0)
    y, held, direction = in_noise(signal, 1.0)
    assert np.mean((course_of(y, held, direction).values - signal) ** 2) < 0.05


def test_where_there_is_no_source_nothing_is_brought_in() -> None:
    y, held, direction = in_noise(np.zeros(4000), 1.0)
    assert np.mean(course_of(y, held, direction).values ** 2) < 0.05
    hidden = course_of(y, np.column_stack([held, direction]), direction)  # all of it looks like a field
    assert not hidden.values.any() and hidden.rms == 0


def test_a_switch_is_known_exactly_and_a_wave_is_no_switch() -> None:
    rng = np.random.default_rng(4)
    state = np.cumsum(rng.uniform(size=3000) < 0.02) % 2.0
    noise = 0.2 * rng.standard_normal(3000)
    found = two_levels(state + noise, 0.2, state + noise)
    assert found is not None
    assert np.sqrt(np.mean((found[0] - state) ** 2)) < 0.05
    wave = np.sin(np.arange(3000) / 50.0)
    assert two_levels(wave + noise, 0.2, wave) is None
    assert two_levels(noise, 0.2, noise) is None


@pytest.mark.parametrize("seed", range(4))
def test_where_every_output_wanders_none_of_them_switches(seed: int) -> None:
    """Each jumps anew sixty times: in such noise any course is near one of two levels. A switch in white noise is."""
    rng = np.random.default_rng(seed)
    held = np.vstack([np.eye(3)] * 4)
    jumps = np.repeat(np.cumsum(rng.standard_normal((60, 12)), axis=0), 50, axis=0)
    direction = np.linalg.svd(jumps - jumps.mean(axis=0), full_matrices=False)[2][0]
    assert not course_of(jumps + rng.standard_normal((3000, 12)), held, direction).switches
    on = np.cumsum(rng.uniform(size=3000) < 0.02) % 2.0
    alone = np.multiply.outer(8.0 * on, direction) + rng.standard_normal((3000, 12))
    assert course_of(alone, held, direction).switches


def test_no_gradient_is_taken_for_the_source() -> None:
    """On another survey the waveform comes from where no field could make it, and nothing else is taken off."""
    rng = np.random.default_rng(8)
    n = 500
    position = standard_geometry("cross", 0.5)
    forward = np.eye(3) + 0.02 * rng.standard_normal((4, 3, 3))
    calibration = ArrayCalibration(np.linalg.inv(forward), 100.0 * rng.standard_normal((4, 3)), np.eye(48), "", (), {})
    field = (rng.standard_normal((n, 8)) @ array_design(position, "gradient").T).reshape(n, 4, 3) * 1000.0
    true = np.einsum("sij,nsj->nsi", forward, field) + calibration.offset
    wave = np.sin(np.arange(n) / 9.0)
    theta = rng.standard_normal(12)
    raw = true + (wave[:, None] * theta).reshape(n, 4, 3)
    record = replace(synthetic(1, n), raw=raw, position=position)
    model = Adopted(MODEL, {"noise_nT": [1.0] * 12})
    np.testing.assert_allclose(corrected_raw(record, calibration, [model], [theta]), true, atol=1e-6)
    np.testing.assert_allclose(corrected_raw(record, calibration, [model], [0.0 * theta]), raw)
    unknown = replace(record, position=None)
    np.testing.assert_array_equal(corrected_raw(unknown, calibration, [model], [theta]), raw)
    two = ArrayCalibration(calibration.matrix[:2], calibration.offset[:2], np.eye(24), "", (), {})
    assert not hidden_waveform(raw[:, :2], two, position[[0, 2]], theta[:6], np.ones(6)).any()


N = 1600
WAVE = np.sin(np.arange(N) / 70.0) * np.cos(np.arange(N) / 411.0)
VECTORS = np.random.default_rng(1).standard_normal((4, 3))


def with_source(sensors: int = 4, size: float = 3.0) -> Record:
    return synthetic(2, N, sensors, added=size * WAVE[:, None, None] * VECTORS[:sensors])


def test_a_source_is_found_with_its_waveform_and_vectors() -> None:
    record = with_source()
    state = linear_state(record)
    found = sought(state, record)
    assert found is not None and found.significant and not found.objection
    before, after = found.gain.rms
    assert after < 1.1 < before
    final, source = tried_source(MODEL, record, state, found, Fitting(), 0.005)
    assert source is not None and not final.objection
    wave = source.record.waveform
    assert wave is not None
    assert abs(np.corrcoef(wave, WAVE)[0, 1]) > 0.99
    theta = source.after.theta[0].reshape(4, 3) * np.sign(wave @ WAVE)
    # 12 values along the field and 9 across from 1600 samples of unit noise: some 0.06 nT
    np.testing.assert_allclose(theta, 3.0 * VECTORS * WAVE.std(), atol=0.25)
    left = sought(source.after, source.record)
    assert left is not None and not left.significant


def test_a_source_that_some_sensors_show_by_themselves_acts_on_all() -> None:
    """Found among three, of which the fourth has been wandering; then fitted on all of them."""
    whole, names = with_source(), ("S1", "S2", "S4")
    some = of_sensors(whole, names)
    shared = sought(state := linear_state(some), some)
    assert shared is not None
    source = tried_source(MODEL, some, state, shared, Fitting(), 0.005)[1]
    assert source is not None and source.record.waveform is not None
    found = narrowed_to(source.after.adopted, source.after.theta, source.after, names)
    model, theta = of_every_sensor(found[0][0], found[1][0], linear_state(whole))
    assert model.sensors == () and len(model.settings["noise_nT"]) == len(theta) == 12
    np.testing.assert_array_equal(theta.reshape(4, 3)[2], 0.0)
    record = replace(whole, waveform=source.record.waveform)
    after = joint_state(record, [model], Fitting(), [theta])
    vectors = after.theta[0].reshape(4, 3) * np.sign(source.record.waveform @ WAVE)
    np.testing.assert_allclose(vectors, 3.0 * VECTORS * WAVE.std(), atol=0.25)
    left = sought(after, record)
    assert left is not None and not left.significant


@pytest.mark.parametrize("size", [0.2, 1.0, 5.0])
@pytest.mark.parametrize("of_the_field", [0.0, 30.0])
def test_the_share_of_a_source_is_what_it_explains(size: float, of_the_field: float) -> None:
    """Of nine values with unit noise off the plane that the sensors share; what of it goes with the field is in C."""
    clean = synthetic(2, N)
    with_the_field = of_the_field * clean.raw[:, 0, 0] / 50_000.0
    wave = size * (WAVE + with_the_field)
    record = replace(clean, raw=clean.raw + wave[:, None, None] * VECTORS)
    found = sought(linear_state(record), record)
    assert found is not None
    off_the_plane = float(np.sum((VECTORS - VECTORS.mean(axis=0)) ** 2))
    power = size**2 * float(np.var(WAVE)) * off_the_plane
    assert found.share == pytest.approx(power / (power + 9.0), rel=0.1, abs=0.02)
    assert f"{found.share:.0%} of the variance of what differs between them" in shared_words(found, record)


def slow(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """A random walk of every output."""
    return 0.1 * np.cumsum(rng.standard_normal(shape), axis=0)


@pytest.mark.parametrize("sensors", [2, 3, 4])
@pytest.mark.parametrize("turning_s", [0.0, 8.0])
def test_independent_slow_noise_has_no_source(sensors: int, turning_s: float) -> None:
    """On a platform that turns slowly C takes a part of each walk, and so the same field goes into all of them."""
    p = []
    for seed in range(8):
        added = slow(np.random.default_rng(seed), (N, sensors, 3))
        record = synthetic(20 + seed, N, sensors, added=added, turning_s=turning_s)
        found = sought(linear_state(record), record)
        assert found is not None
        p.append(found.p)
    assert min(p) > ALPHA
    assert np.median(p) > 0.1


def objection(record: Record) -> str:
    """Why the source of a record is not adopted; it has to be significant."""
    state = linear_state(record)
    found = sought(state, record)
    assert found is not None and found.significant
    final, source = tried_source(MODEL, record, state, found, Fitting(), 0.005)
    assert (source is None) == bool(final.objection)
    return final.objection


def test_one_sensor_alone_and_two_sensors() -> None:
    alone = np.zeros((4, 3))
    alone[1] = 3.0
    record = synthetic(2, N, added=WAVE[:, None, None] * alone)
    found = sought(linear_state(record), record)
    assert found is not None and not found.significant  # any noise of that sensor would look the same
    assert "two sensors" in objection(with_source(sensors=2))
    single = synthetic(3, N, sensors=1)
    assert sought(linear_state(single), single) is None


def test_what_follows_a_channel_is_not_blamed_on_a_hidden_source() -> None:
    record = with_source()
    logged = {"pump": WAVE + 0.2 * np.random.default_rng(5).standard_normal(N)}
    known = replace(record, logged=logged, origins={"pump": np.zeros(())}, units={"pump": "A"})
    assert "pump" in objection(known)
    tried = sought(linear_state(known), known, may_follow=True)  # the channel was adopted, and leaves much of it
    assert tried is not None and tried.significant and not tried.objection


@pytest.mark.parametrize("rank", [1, 3])
def test_what_follows_the_attitude_is_no_source(rank: int) -> None:
    """One quadratic form of the direction times a vector at each sensor, or three of them: no catalogue has that."""
    clean = synthetic(2, N)
    u = clean.raw.mean(axis=1) / 50_000.0
    forms = np.column_stack([u[:, 0] * u[:, 1], u[:, 1] * u[:, 2], u[:, 2] * u[:, 0]])[:, :rank]
    response = 10.0 * np.random.default_rng(7).standard_normal((rank, 12))
    words = objection(replace(clean, raw=clean.raw + (forms @ response).reshape(clean.raw.shape)))
    assert words == (
        "its waveform follows the direction of the field"
        if rank == 1
        else "one waveform does not explain what the sensors share"
    )


def test_a_kink_of_the_field_is_no_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """Amplifiers with a gain of their own beyond a reading, alike in x of all sensors: a curve of the field along x, of
    which laws of low degree leave most."""
    monkeypatch.setattr(latent, "attitude_series", lambda x: np.zeros((len(x.time), 1)))
    size = np.array([1.0, -0.8, 1.2, 0.6])
    clean = synthetic(2, 2 * N)
    x = linear_state(clean).excitation
    u = x.field[:, 0] / 50_000.0
    kink = np.abs(u[:, 0] - 0.2)
    curved = clean.raw.copy()
    curved[:, :, 0] += 40.0 * kink[:, None] * size
    assert objection(replace(clean, raw=curved)) == "its waveform follows the direction of the field"
    assert not objection(with_source())

    half = len(u) // 2
    left = []
    for series in (attitude_series(x), curve_series(x)):
        known = np.column_stack([np.ones(len(u)), u, series])
        theta = np.linalg.lstsq(known[:half], kink[:half], rcond=1e-9)[0]
        left.append(np.std(kink[half:] - known[half:] @ theta))
    assert left[1] < 0.2 * left[0]


@pytest.mark.parametrize("alike", [True, False])
def test_what_an_effect_may_have_left_is_no_source(alike: bool) -> None:
    """A waveform that moves the sensors as an adopted effect does, and one that moves them otherwise."""
    pump = np.cos(np.arange(N) / 33.0)
    effect = VECTORS if alike else np.random.default_rng(9).standard_normal((4, 3))
    record = synthetic(2, N, added=3.0 * WAVE[:, None, None] * VECTORS + 12.0 * pump[:, None, None] * effect)
    known = replace(record, logged={"pump": pump}, origins={"pump": np.zeros(())}, units={"pump": "A"})
    response = Adopted(Registry.load().find("error_model", "channel_response"), {"channel": "pump"})
    state = joint_state(known, [response], Fitting())
    found = sought(state, known)
    assert found is not None and found.significant
    assert found.objection == ("the sensors feel it as they feel channel_response, which may leave it" if alike else "")
