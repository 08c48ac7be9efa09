"""The field: sources, their gradients, the Earth's variation, and the view from the platform."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import welch
from scipy.spatial.transform import Rotation
from simulate_cases import NOISELESS, scenario

from magtensor.simulate import simulate
from magtensor.simulate.field import EarthSpec, Variation, VariationSpec
from magtensor.simulate.run import Simulated
from magtensor.simulate.sources import Dipole, UniformGradient, dipole_field, traceless_symmetric


def test_dipole_on_and_off_axis() -> None:
    moment = np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(dipole_field(moment, np.array([0.0, 0.0, 1.0])), [0, 0, 200.0])  # mu0 m / 2 pi r^3
    np.testing.assert_allclose(dipole_field(moment, np.array([2.0, 0.0, 0.0])), [0, 0, -12.5])


@pytest.mark.parametrize(
    "source",
    [
        Dipole(np.array([0.3, -2.0, 1.0]), np.array([5.0, -3.0, 8.0])),
        Dipole(np.array([1.0, 1.0, 1.5]), np.array([5.0, 1.0, -2.0]), np.array([0.5, 2.0, 0.0]), 3.0),
        UniformGradient(traceless_symmetric([1.0, 2.0, 3.0, 4.0, 5.0])),
    ],
)
def test_gradient_is_symmetric_traceless_and_the_derivative_of_the_field(
    source: Dipole | UniformGradient,
) -> None:
    x = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))
    t = np.linspace(0, 5, 20)
    gradient = source.gradient(t, x)
    np.testing.assert_allclose(gradient, np.swapaxes(gradient, 1, 2), atol=1e-9)
    np.testing.assert_allclose(np.trace(gradient, axis1=1, axis2=2), 0.0, atol=1e-9)
    h = 1e-4
    for j in range(3):
        step = h * np.eye(3)[j]
        difference = (source.field(t, (x + step)[:, None]) - source.field(t, (x - step)[:, None]))[:, 0] / (2 * h)
        np.testing.assert_allclose(gradient[:, :, j], difference, rtol=1e-5, atol=1e-4)


def test_earth_field_elements_and_vector() -> None:
    earth = EarthSpec(total_field_nT=50000.0, inclination_deg=30.0, declination_deg=90.0).vector()
    np.testing.assert_allclose(earth, [50000 * np.cos(np.pi / 6), 0.0, -25000.0], atol=1e-9)
    with pytest.raises(ValueError, match="vector_nT"):
        EarthSpec(total_field_nT=50000.0)


def test_total_field_does_not_depend_on_the_attitude() -> None:
    survey = simulate(NOISELESS)
    np.testing.assert_allclose(np.linalg.norm(survey.truth.b, axis=-1), 50000.0, rtol=1e-12)
    np.testing.assert_allclose(survey.truth.total_field, 50000.0, rtol=1e-12)
    np.testing.assert_array_equal(survey.truth.tensor, 0.0)


def test_platform_field_is_the_world_field_seen_through_the_attitude() -> None:
    survey = simulate(NOISELESS)
    world = Rotation.from_quat(survey.truth.attitude).apply(survey.truth.b[:, 0])
    earth = EarthSpec(total_field_nT=50000.0, inclination_deg=60.0, declination_deg=5.0).vector()
    np.testing.assert_allclose(world, np.broadcast_to(earth, world.shape), atol=1e-6)


def near_dipoles() -> Simulated:
    field = NOISELESS["field"] | {"dipoles": [{"position_m": [2.0, 1.0, -1.5], "moment_Am2": [3.0, -20.0, 40.0]}]}
    return simulate(
        scenario(field=field, effects=[{"type": "site_gradient", "tensor_nT_per_m": [5.0, -8.0, 3.0, 1.0, 9.0]}])
    )


def test_tensor_is_the_derivative_of_the_field_across_the_array() -> None:
    """The differences over the cross's baseline miss only the third derivative: (d^2 / 24) d3B."""
    survey = near_dipoles()
    b, tensor, d = survey.truth.b, survey.truth.tensor, 0.5
    np.testing.assert_allclose(tensor, np.swapaxes(tensor, 1, 2), atol=1e-9)
    np.testing.assert_allclose(np.trace(tensor, axis1=1, axis2=2), 0.0, atol=1e-9)
    by_x, by_y = (b[:, 0] - b[:, 2]) / d, (b[:, 1] - b[:, 3]) / d
    size = np.abs(tensor).max()
    r = np.linalg.norm([2.0, 1.0, -1.5])
    assert np.abs(by_x - tensor[:, :, 0]).max() < 2 * (d / r) ** 2 * size
    assert np.abs(by_y - tensor[:, :, 1]).max() < 2 * (d / r) ** 2 * size
    assert np.abs(by_x - tensor[:, :, 0]).max() > 1e-4 * size  # the finite baseline is there by itself


def test_tensor_invariants_do_not_depend_on_the_attitude_at_a_fixed_centre() -> None:
    tensor = near_dipoles().truth.tensor
    second = np.einsum("nij,nji->n", tensor, tensor)
    np.testing.assert_allclose(second, second[0], rtol=1e-9)
    np.testing.assert_allclose(np.linalg.det(tensor), np.linalg.det(tensor[0]), rtol=1e-8)


def test_uniform_site_gradient_turns_with_the_platform() -> None:
    survey = simulate(scenario(effects=[{"type": "site_gradient", "tensor_nT_per_m": [10.0, 0.0, 0.0, -10.0, 0.0]}]))
    r = Rotation.from_quat(survey.truth.attitude).as_matrix()
    expected = np.swapaxes(r, 1, 2) @ np.diag([10.0, -10.0, 0.0]) @ r
    np.testing.assert_allclose(survey.truth.tensor, expected, atol=1e-10)
    # in a uniform gradient the differences across the array are exact
    np.testing.assert_allclose((survey.truth.b[:, 0] - survey.truth.b[:, 2]) / 0.5, expected[:, :, 0], atol=1e-7)


def test_diurnal_variation_peaks_at_noon() -> None:
    spec = VariationSpec.model_validate({"diurnal": {"amplitude_nT": [1.0, -20.0, 5.0], "start_hour": 9.0}})
    variation = Variation(spec, np.random.default_rng(1), 86400.0)
    t = np.arange(0.0, 86400.0, 60.0)
    assert t[np.argmin(variation(t)[:, 1])] == pytest.approx(3 * 3600, abs=60)
    np.testing.assert_allclose(variation(np.array([3 * 3600.0]))[0], [1.0, -20.0, 5.0])


def test_pulsations_have_their_rms_and_period() -> None:
    spec = VariationSpec.model_validate(
        {"pulsations": [{"rms_nT": 2.0, "period_s": 30.0, "direction": [0.0, 1.0, 0.0]}]}
    )
    variation = Variation(spec, np.random.default_rng(1), 1e5)
    wave = variation(np.arange(0.0, 1e5))[:, 1]
    assert wave.std() == pytest.approx(2.0, rel=0.05)
    frequency, density = welch(wave, 1.0, nperseg=4096)
    mean = np.sum(frequency * density) / np.sum(density)
    assert mean == pytest.approx(1 / 30, rel=0.1)
    assert np.sum(density[np.abs(frequency * 30 - 1) < 0.7]) > 0.97 * np.sum(density)
