"""A degenerate fit is refused with the attitudes that are missing, never reported as a success."""

import re

import numpy as np
import pytest
from paper_setups import CHI_FIELD, chi_response, directions, tilted, triangle

from magtensor import DataError, NotEnoughData
from magtensor.calibration.coverage import coverage
from magtensor_methods import chi2017, eigen_square_root, li2018, li2018_linear, yin2014, zhang2015

FIELD = 50_000.0
RESPONSE = triangle(np.array([1.02, 0.99, 1.01]), 0.01, -0.008, 0.006)
OFFSET = np.array([120.0, -80.0, 60.0])
METHODS = [chi2017, eigen_square_root, li2018_linear, yin2014, zhang2015]


def measure(unit: np.ndarray, noise: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    raw = FIELD * unit @ RESPONSE.T + OFFSET + noise * rng.normal(size=unit.shape)
    return raw, np.full(len(unit), FIELD)


def circle(angle: np.ndarray, height: float) -> np.ndarray:
    r = np.sqrt(1 - height**2)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(len(angle), height)])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("height", [0.0, 0.7])
@pytest.mark.parametrize("noise", [0.0, 1.0, 100.0])
@pytest.mark.parametrize("count", [12, 200, 20_000])
def test_rotation_about_one_axis_is_refused(method, height: float, noise: float, count: int) -> None:
    """Noise lends a planar rotation an extent along its axis: the more samples, the better it looks."""
    rng = np.random.default_rng(count)
    raw, field = measure(circle(rng.uniform(0, 2 * np.pi, count), height), noise, rng)
    with pytest.raises(NotEnoughData) as refused:
        method(raw, field)
    message = str(refused.value)
    assert "condition number" in message
    assert "-z" in message
    assert "cone without a sample" in message


def test_noise_never_passes_for_coverage() -> None:
    rng = np.random.default_rng(1)
    for trial in range(400):
        count = int(rng.integers(10, 60))
        unit = circle(rng.uniform(0, 2 * np.pi, count), rng.uniform(-0.8, 0.8))
        raw, field = measure(unit, 10 ** rng.uniform(-1, 2), rng)
        with pytest.raises(NotEnoughData):
            chi2017(raw, field)
            pytest.fail(f"trial {trial} with {count} samples was accepted")


@pytest.mark.parametrize("method", METHODS)
def test_a_sensor_at_rest_hears_that_it_never_turned(method) -> None:
    """The surface through a day at an observatory lies within the cluster of samples, and sees them all round."""
    rng = np.random.default_rng(3)
    raw, _ = measure(np.tile([0.4, 0.0, 0.9165], (20_000, 1)), 20.0, rng)
    with pytest.raises(NotEnoughData) as refused:
        method(raw, np.linalg.norm(raw, axis=1) + rng.normal(size=len(raw)))
    half_angle = re.search(r"cone without a sample: (\d+) deg", str(refused.value))
    assert half_angle and int(half_angle[1]) > 170
    assert "+x, +y, -x, -y, -z" in str(refused.value)


@pytest.mark.parametrize("method", METHODS)
def test_eight_attitudes_held_for_long_are_refused(method) -> None:
    rng = np.random.default_rng(2)
    raw, field = measure(np.repeat(directions(rng, 8), 200, axis=0), 1.0, rng)
    with pytest.raises(NotEnoughData):
        method(raw, field)


def test_ten_attitudes_held_for_long_are_accepted() -> None:
    rng = np.random.default_rng(3)
    raw, field = measure(np.repeat(directions(rng, 12), 200, axis=0), 1.0, rng)
    assert coverage(raw, field).distinct >= 12
    assert chi2017(raw, field).residual_rms < 2.0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_one_attitude_is_refused(method, noise: float) -> None:
    rng = np.random.default_rng(4)
    raw, field = measure(np.tile(directions(rng, 1), (100, 1)), noise, rng)
    with pytest.raises(NotEnoughData, match="x and y and z output never changed"):
        method(raw, field)


def test_nine_samples_are_refused() -> None:
    rng = np.random.default_rng(5)
    with pytest.raises(NotEnoughData, match="9 samples"):
        chi2017(*measure(directions(rng, 9), 1.0, rng))


@pytest.mark.parametrize("dead", [0.0, 0.5])
def test_a_dead_axis_is_named(dead: float) -> None:
    rng = np.random.default_rng(6)
    raw, field = measure(directions(rng, 300), 1.0, rng)
    raw[:, 1] = 40.0 + dead * rng.normal(size=300)
    with pytest.raises(NotEnoughData, match="the y output never changed"):
        chi2017(raw, field)


@pytest.mark.parametrize("method", METHODS)
def test_limited_tilt_passes_with_honest_errors(method) -> None:
    """200 postures within +-20 deg at 1 nT: allowed, and the predicted error covers the true one."""
    rng = np.random.default_rng(7)
    sphere = directions(rng, 400)
    for _ in range(10):
        found = method(*measure(tilted(rng, 200, 20.0), 1.0, rng))
        truth = FIELD * sphere @ RESPONSE.T + OFFSET
        error = np.abs(np.linalg.norm(found.apply(truth), axis=1) - FIELD).max()
        if method is not zhang2015:  # what Zhang neglects is no matter of the attitudes
            assert error < 4 * float(found.diagnostics["worst_error_nT"])
            assert float(found.diagnostics["worst_error_nT"]) < 50
        assert "-z" in str(found.diagnostics["missing_attitudes"])


def test_twelve_postures_at_limited_tilt_are_judged_by_their_errors() -> None:
    rng = np.random.default_rng(8)
    accepted = 0
    for _ in range(30):
        raw, field = measure(tilted(rng, 12, 20.0), 1.0, rng)
        try:
            found = chi2017(raw, field)
        except NotEnoughData as refused:
            assert "predicted error" in str(refused)
        else:
            accepted += 1
            assert float(found.diagnostics["worst_error_nT"]) < 0.05 * FIELD
    assert accepted > 20


@pytest.mark.parametrize("fit", ["ellipsoid", "gradient"])
def test_an_accepted_fit_is_what_it_predicts(fit: str) -> None:
    """A planar rotation with a wobble from nothing to 20 deg: accepted or not, never a wrong result."""
    rng = np.random.default_rng(9)
    sphere = directions(rng, 300)
    truth = FIELD * sphere @ RESPONSE.T + OFFSET
    accepted = 0
    for wobble in (0.02, 0.1, 0.3, 1.0, 3.0, 10.0, 20.0):
        for count in (20, 200, 5000):
            for noise in (0.1, 1.0, 10.0):
                z = np.sin(np.radians(wobble)) * rng.uniform(-1, 1, count)
                r, turn = np.sqrt(1 - z**2), rng.uniform(0, 2 * np.pi, count)
                unit = np.column_stack([r * np.cos(turn), r * np.sin(turn), z])
                try:
                    found = chi2017(*measure(unit, noise, rng), fit=fit)
                except NotEnoughData:
                    continue
                accepted += 1
                error = np.abs(np.linalg.norm(found.apply(truth), axis=1) - FIELD).max()
                assert error < 4 * float(found.diagnostics["worst_error_nT"]), (wobble, count, noise)
    assert accepted > 10


def test_strong_soft_iron_is_no_lack_of_coverage() -> None:
    rng = np.random.default_rng(10)
    c, o = chi_response()
    for s in range(4):
        raw = (CHI_FIELD * directions(rng, 30)) @ c[s].T + o[s] + 3 * rng.normal(size=(30, 3))
        assert chi2017(raw, np.full(30, CHI_FIELD)).residual_rms < 5


def test_the_second_distance_is_a_distance() -> None:
    """Two parallel planes 2h apart: the nearest quadric holds both; noise puts its distance at the noise."""
    rng = np.random.default_rng(11)
    raw, field = measure(directions(rng, 4000), 3.0, rng)
    seen = coverage(raw, field)
    assert seen.distance == pytest.approx(3.0, rel=0.05)
    assert seen.second_distance > 10_000
    flat, field = measure(circle(rng.uniform(0, 6.3, 4000), 0.3), 3.0, rng)
    seen = coverage(flat, field)
    assert seen.second_distance == pytest.approx(3.0, rel=0.15)
    assert not seen.determined


def test_empty_cones() -> None:
    rng = np.random.default_rng(12)
    unit = directions(rng, 5000)
    unit = unit[unit @ np.array([0.6, 0.0, -0.8]) < np.cos(np.radians(50))]
    seen = coverage(FIELD * unit, np.full(len(unit), FIELD))
    (cone,) = seen.empty_cones
    assert cone.half_angle_deg == pytest.approx(50, abs=4)
    np.testing.assert_allclose(cone.axis, [0.6, 0, -0.8], atol=0.1)
    # -z lies 36.9 deg from the hole's axis: 13 deg from its rim
    assert seen.unseen == ()
    assert coverage(FIELD * unit[unit[:, 2] > -0.5], np.full((unit[:, 2] > -0.5).sum(), FIELD)).unseen == ("-z",)


def test_array_method_names_the_sensor() -> None:
    rng = np.random.default_rng(13)
    raw, field = measure(directions(rng, 100), 1.0, rng)
    both = np.stack([raw, raw + 5 * rng.normal(size=raw.shape)], axis=1)
    both[:, 1, 2] = 17.0
    with pytest.raises(NotEnoughData, match="sensor 2: the attitudes") as refused:
        li2018(both, field)
    assert "z output never changed" in str(refused.value)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_no_fit_can_use(bad: float) -> None:
    rng = np.random.default_rng(14)
    raw, field = measure(directions(rng, 50), 1.0, rng)
    broken = raw.copy()
    broken[7, 2] = bad
    with pytest.raises(DataError, match="finite"):
        chi2017(broken, field)
    with pytest.raises(DataError, match="positive"):
        chi2017(raw, np.where(np.arange(50) == 3, 0.0, field))
