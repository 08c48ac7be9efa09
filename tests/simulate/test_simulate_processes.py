"""The building blocks: rotations, smooth random functions, the first-order lag, the play operator, the noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import welch
from scipy.spatial.transform import Rotation

from magtensor.simulate import rotations
from magtensor.simulate.noise import NoiseSpec, flicker, sensor_noise
from magtensor.simulate.processes import SmoothRandom, low_pass, play


def test_rotations_agree_with_scipy() -> None:
    rng = np.random.default_rng(1)
    q = rotations.uniform_attitudes(rng, 500)
    p = rotations.uniform_attitudes(rng, 500)
    vector = rng.standard_normal((500, 3))
    theirs = Rotation.from_quat(q)
    np.testing.assert_allclose(rotations.matrices(q), theirs.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(
        rotations.matrices(rotations.multiply(p, q)), (Rotation.from_quat(p) * theirs).as_matrix(), atol=1e-14
    )
    np.testing.assert_allclose(rotations.logarithm(q), theirs.as_rotvec(), atol=1e-7)
    np.testing.assert_allclose(
        rotations.matrices(rotations.exponential(vector)),
        Rotation.from_rotvec(vector).as_matrix(),
        atol=1e-14,
    )
    np.testing.assert_allclose(rotations.transform(rotations.matrices(q), vector), theirs.apply(vector), atol=1e-14)
    np.testing.assert_allclose(
        rotations.matrices(rotations.quaternions(theirs.as_matrix())), theirs.as_matrix(), atol=1e-14
    )


def test_small_rotations_lose_no_digits() -> None:
    tiny = np.array([[1e-9, -2e-9, 3e-9], [0.0, 0.0, 0.0], [1e-300, 0.0, 0.0]])
    np.testing.assert_allclose(rotations.logarithm(rotations.exponential(tiny)), tiny, rtol=1e-12, atol=1e-290)


@pytest.mark.parametrize("quarter", ["x", "y", "z"])
def test_passive_rotation_about_an_axis(quarter: str) -> None:
    theirs = Rotation.from_euler(quarter, 0.3).as_matrix().T  # passive: the inverse of turning the vector
    np.testing.assert_allclose(rotations.passive(quarter, 0.3), theirs, atol=1e-15)


@pytest.mark.parametrize("n", [1, 2, 3, 10, 101])
def test_cumulative_products(n: int) -> None:
    q = rotations.uniform_attitudes(np.random.default_rng(n), n)
    product = Rotation.identity()
    for i, running in enumerate(rotations.cumulative(q)):
        product = product * Rotation.from_quat(q[i])
        np.testing.assert_allclose(rotations.matrices(running), product.as_matrix(), atol=1e-13)


def test_smooth_random_has_the_rms_and_is_smooth() -> None:
    smooth = SmoothRandom(np.random.default_rng(2), (-10.0, 40000.0), 4.0, 3.0, 2)
    t = np.arange(0, 39990.0, 0.5)
    # 10 000 knots: the rms of the sample is known to about 1 %
    np.testing.assert_allclose(np.sqrt(np.mean(smooth(t) ** 2, axis=0)), 3.0, rtol=0.04)
    h = 1e-3
    knot = -10.0 + 4.0 * 7
    before, after = (smooth(knot + side * np.array([1, 2, 3]) * h) for side in (-1, 1))
    second = (before[0] - 2 * smooth(np.array([knot]))[0] + after[0]) / h**2
    second_before = (smooth(np.array([knot]))[0] - 2 * before[0] + before[1]) / h**2
    np.testing.assert_allclose(second, second_before, atol=1e-2)
    with pytest.raises(ValueError, match="outside"):
        smooth(np.array([40010.0]))


@pytest.mark.parametrize("tau", [1e-4, 0.03, 0.1, 1.0, 50.0])
def test_low_pass_sinusoid(tau: float) -> None:
    omega, time = 0.7, np.arange(0.0, 400.0, 0.1)
    x = low_pass(lambda t: np.cos(omega * t)[:, None], time, tau)[:, 0]
    gain = 1 / (1 + 1j * omega * tau)
    exact = (gain * np.exp(1j * omega * time)).real
    settled = exact + (1.0 - gain.real) * np.exp(-time / tau)  # starts as if the input had rested at its first value
    np.testing.assert_allclose(x, settled, atol=2e-7)


def test_low_pass_is_exact_for_parabolas() -> None:
    time, tau = np.linspace(0.0, 3.0, 31), 0.4
    x = low_pass(lambda t: (2 + 3 * t - 5 * t**2)[:, None], time, tau, substeps=1)[:, 0]
    forced = 2 + 3 * time - 5 * time**2 - tau * (3 - 10 * time) + tau**2 * (-10)
    exact = forced + (2 - forced[0]) * np.exp(-time / tau)
    np.testing.assert_allclose(x, exact, atol=1e-12)


def test_low_pass_step_response() -> None:
    time = np.arange(0.0, 20.0, 0.1)
    x = low_pass(lambda t: (t > 5.0).astype(float)[:, None], time, np.array([2.0]), substeps=4)[:, 0]
    exact = np.where(time > 5.0, -np.expm1(-(time - 5.0) / 2.0), 0.0)
    np.testing.assert_allclose(x, exact, atol=0.02)  # the step falls within a substep of 25 ms


def test_low_pass_without_time_constant_is_the_input_itself() -> None:
    time = np.arange(0.0, 5.0, 0.1)
    np.testing.assert_array_equal(low_pass(lambda t: np.sin(t)[:, None], time, 0.0)[:, 0], np.sin(time))


@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_low_pass_does_not_depend_on_the_chunk(chunk: int) -> None:
    time = np.arange(0.0, 30.0, 0.1)

    def u(t: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(t), np.cos(3 * t)], axis=-1)

    whole = low_pass(u, time, np.array([0.05, 3.0]))
    np.testing.assert_array_equal(low_pass(u, time, np.array([0.05, 3.0]), chunk=chunk), whole)


def test_play_is_the_textbook_recursion() -> None:
    u = np.cumsum(np.random.default_rng(3).standard_normal((997, 2)), axis=0)
    expected = np.empty_like(u)
    state = u[0]
    for i, value in enumerate(u):
        state = np.minimum(np.maximum(state, value - 1.5), value + 1.5)
        expected[i] = state
    np.testing.assert_array_equal(play(u, 1.5), expected)
    first = play(u[:400], 1.5)
    np.testing.assert_array_equal(np.concatenate([first, play(u[400:], 1.5, first[-1])]), expected)


def test_play_loop_is_twice_the_half_width_wide() -> None:
    t = np.linspace(0, 4 * np.pi, 40001)
    p = play(10 * np.sin(t)[:, None], 2.0)[:, 0]
    rising, falling = np.argmin(np.abs(t - 2 * np.pi)), np.argmin(np.abs(t - np.pi))
    assert p[falling] - p[rising] == pytest.approx(4.0, abs=1e-2)
    assert p[t > np.pi].max() == pytest.approx(8.0, abs=1e-6)


@pytest.mark.parametrize("exponent", [1.0, 1.6])
def test_flicker_follows_its_law(exponent: float) -> None:
    rate, level = 10.0, 0.2
    noise = flicker(np.random.default_rng(4), 1 << 18, rate, level, exponent)
    frequency, density = welch(noise, rate, nperseg=1 << 13, window="hann")
    for low, high in ((0.01, 0.03), (0.03, 0.1), (0.1, 0.5), (0.5, 4.5)):
        band = (frequency >= low) & (frequency < high)
        law = level**2 / frequency[band] ** exponent
        # 63 averages and at least 16 frequencies: the mean ratio is known to about 3 %
        assert np.mean(density[band] / law) == pytest.approx(1.0, abs=0.12), (low, high)


def test_noise_has_the_white_level_on_each_axis_and_independent_axes() -> None:
    spec = NoiseSpec(white_sd_nT=[[0.1, 0.2, 0.3], [1.0, 0.0, 2.0]])
    noise = np.stack(list(sensor_noise(spec, np.random.default_rng(5), 20000, 10.0, 2)), axis=1)
    np.testing.assert_allclose(noise.std(axis=0), [[0.1, 0.2, 0.3], [1.0, 0.0, 2.0]], rtol=0.03)
    white = noise.reshape(-1, 6)[:, [0, 1, 2, 3, 5]]
    correlation = np.corrcoef(white.T) - np.eye(5)
    assert np.abs(correlation).max() < 5 / np.sqrt(20000)


def test_white_and_flicker_add_in_power() -> None:
    spec = NoiseSpec(white_sd_nT=0.15, flicker_nT_per_rtHz=0.05)
    noise = next(iter(sensor_noise(spec, np.random.default_rng(6), 1 << 18, 10.0, 1)))[:, 0]
    frequency, density = welch(noise, 10.0, nperseg=1 << 12)
    for low, high in ((0.02, 0.05), (0.3, 1.0), (3.0, 4.9)):
        band = (frequency >= low) & (frequency < high)
        law = 2 * 0.15**2 / 10.0 + 0.05**2 / frequency[band]
        assert np.mean(density[band] / law) == pytest.approx(1.0, abs=0.1)
