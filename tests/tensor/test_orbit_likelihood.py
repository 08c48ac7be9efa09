"""Maximum likelihood on the orbit: derivatives, identifiability, errors against the noise floor, refusals."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sui_simulation import MOMENT, NOISE_STD, Gradiometer, dipole_components, random_gradiometer, rotated_components

from magtensor import DataError, NotEnoughData, UsageError
from magtensor.tensor.elements import METRIC, five, full, rotation_of_five
from magtensor.tensor.invariants import invariants
from magtensor.tensor.orbit import (
    Surface,
    curvature_pull,
    derivatives,
    feet,
    noise_information,
    normals,
    shape_angle,
    smallest_radius,
    unit_eigenvalues,
)
from magtensor.tensor.refinement import nearest_in_gauge, normalised_determinant
from magtensor_methods.orbit_likelihood import orbit_likelihood
from magtensor_methods.sui2017 import sui2017

ON_AXIS = MOMENT / np.linalg.norm(MOMENT)
BROADSIDE = np.array([1.0, -1.0, 0.0]) / np.sqrt(2)
SIDE = np.cross(ON_AXIS, BROADSIDE)
STRAIGHT_ABOVE = np.array([0.0, 0.0, 1.0])


def off_axis(degrees):
    return np.cos(np.radians(degrees)) * ON_AXIS + np.sin(np.radians(degrees)) * SIDE


def i1_and_i2(g):
    found = invariants(full(g)[None])
    return float(found.i1[0]), float(found.i2[0])


def gauss(gradiometer, truth, rng, noise=NOISE_STD):
    return gradiometer.measure(truth, rng, 0.0) + noise * rng.normal(size=truth.shape)


def turn_to(found, true_matrix):
    return rotation_of_five(nearest_in_gauge(found.matrix, true_matrix)[0])


def rms(error):
    return float(np.sqrt(np.mean(np.square(error))))


def surface_and_readings(seed, height=50.0, count=60, noise=NOISE_STD):
    """In units of C_T; the noise is that much in nT/m."""
    rng = np.random.default_rng(seed)
    g = dipole_components(height)
    magnitude = np.linalg.norm(full(g))
    gradiometer, truth = random_gradiometer(rng), rotated_components(g, rng, count)
    angle = shape_angle(normalised_determinant(*i1_and_i2(g)))
    surface = Surface(gradiometer.K, gradiometer.O / magnitude, angle)
    return surface, gauss(gradiometer, truth, rng, noise) / magnitude


# --- the orbit ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [-0.2, 0.0, 0.4, np.pi / 6, 1.0, np.pi / 3, 1.3])
def test_the_angle_of_the_shape(angle):
    values, slopes = unit_eigenvalues(angle)
    assert values.sum() == pytest.approx(0, abs=1e-15) and slopes.sum() == pytest.approx(0, abs=1e-15)
    assert [values @ values, slopes @ slopes, values @ slopes] == pytest.approx([1, 1, 0])
    assert 3 * np.sqrt(6) * np.prod(values) == pytest.approx(np.cos(3 * angle))
    if 0 <= angle <= np.pi / 3:
        assert (np.diff(values) <= 1e-15).all()
        # equal differences of eigenvalues make circles of radius sin(angle) and sin(60 deg - angle)
        assert smallest_radius(angle) == pytest.approx(min(np.sin(angle), np.sin(np.pi / 3 - angle)), abs=1e-12)


@pytest.mark.parametrize("angle", [0.02, 0.5, 1.02])
def test_feet_are_the_nearest_points(angle):
    """Against every rotation of a fine random set, which can only be farther."""
    rng = np.random.default_rng(0)
    surface = Surface(np.eye(5) + 0.1 * rng.normal(size=(5, 5)), rng.normal(size=5), angle)
    values = unit_eigenvalues(angle)[0]
    orbit = five(np.einsum("nik,k,njk->nij", *[(q := Rotation.random(4000, random_state=1).as_matrix()), values, q]))
    readings = orbit[:50] @ surface.mixing.T + surface.offset + 0.02 * rng.normal(size=(50, 5))
    found = feet(readings, surface)
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    distance = np.linalg.norm(found.residual, axis=1)
    others = np.linalg.norm(readings[:, None] - surface.offset - orbit @ surface.mixing.T, axis=2)
    assert (distance <= others.min(axis=1)).all()
    normal = normals(surface, found)
    along = found.residual - np.einsum("nck,ndk,nd->nc", normal, normal, found.residual)
    assert np.abs(along).max() < 1e-8


def steps(size=1e-5):
    return size * np.eye(31)


def test_gradient_of_the_likelihood_is_that_of_finite_differences():
    surface, readings = surface_and_readings(1)
    found = feet(readings, surface)
    normal = normals(surface, found)
    off = np.einsum("nck,nc->nk", normal, found.residual).ravel()
    analytic = -2 * derivatives(surface, found, normal).T @ off
    numeric = [(feet(readings, surface.moved(e)).cost - feet(readings, surface.moved(-e)).cost) / 2e-5 for e in steps()]
    np.testing.assert_allclose(analytic, numeric, atol=1e-6 * np.abs(analytic).max())


def test_derivatives_of_the_residuals_are_those_of_finite_differences():
    surface, readings = surface_and_readings(2, noise=0.0)
    found = feet(readings, surface)
    normal = normals(surface, found)
    moved = [
        (feet(readings, surface.moved(e)).residual - feet(readings, surface.moved(-e)).residual) / 2e-5 for e in steps()
    ]
    numeric = np.stack([np.einsum("nck,nc->nk", normal, r).ravel() for r in moved], axis=1)
    np.testing.assert_allclose(-derivatives(surface, found, normal), numeric, atol=1e-6)


def test_the_gauge_moves_no_foot_and_carries_no_information():
    surface, readings = surface_and_readings(3)
    found = feet(readings, surface)
    normal = normals(surface, found)
    np.testing.assert_allclose(derivatives(surface, found, normal) @ surface.gauge().T, 0, atol=1e-12)
    noise = noise_information(surface, found, normal)
    np.testing.assert_allclose(noise @ surface.gauge().T / np.abs(noise).max(), 0, atol=1e-12)


def test_curvature_pulls_the_residual_and_noise_adds_information():
    """Both are second order in the noise: against 60 000 noisy readings of three points."""
    surface, readings = surface_and_readings(4, count=3, noise=0.0)
    exact = feet(readings, surface)
    rng, noise = np.random.default_rng(5), 0.006
    many = np.repeat(readings, 20000, axis=0)
    found = feet(many + noise * rng.normal(size=many.shape), surface)
    normal = normals(surface, found)
    off = np.einsum("nck,nc->nk", normal, found.residual).reshape(3, -1, 2)
    expected = curvature_pull(surface, exact, normals(surface, exact))
    error = 1 / (noise * np.sqrt(20000))
    np.testing.assert_allclose(off.mean(axis=1) / noise**2, expected, atol=5 * error + 0.02 * np.abs(expected).max())
    gram = lambda f, n: derivatives(surface, f, n).T @ derivatives(surface, f, n)  # noqa: E731
    at_truth = gram(exact, normals(surface, exact))
    predicted = noise_information(surface, exact, normals(surface, exact))
    # directions that the three points leave empty: 31 less 6
    empty = np.linalg.svd(at_truth)[0][:, 6:]
    seen = np.trace(empty.T @ gram(found, normal) @ empty) / 20000 / noise**2
    assert seen == pytest.approx(np.trace(empty.T @ predicted @ empty), rel=0.15)


# --- the estimate ------------------------------------------------------------------------------------------


def test_without_noise_it_is_exact_up_to_one_rotation():
    rng = np.random.default_rng(6)
    g = dipole_components(20.0)
    gradiometer, truth = random_gradiometer(rng), rotated_components(g, rng, 60)
    found = orbit_likelihood(full(gradiometer.measure(truth, rng, 0.0)), *i1_and_i2(g))
    true_matrix = np.linalg.inv(gradiometer.K)
    turn = turn_to(found, true_matrix)
    np.testing.assert_allclose(turn @ found.matrix, true_matrix, atol=1e-7)
    np.testing.assert_allclose(turn @ found.offset, -true_matrix @ gradiometer.O, atol=1e-5)
    assert (found.rank, found.nullity, found.gauge.shape) == (27, 3, (3, 30))
    assert nearest_in_gauge(found.matrix, np.eye(5))[1] < 1e-9
    assert any("orientation" in words and "unidentified" in words for words in found.verdict)


@pytest.mark.parametrize("known", ["I1", "neither"])
def test_constancy_leaves_the_scale_open_and_finds_the_shape(known):
    rng = np.random.default_rng(7)
    g = dipole_components(20.0, off_axis(70))
    gradiometer, truth = random_gradiometer(rng), rotated_components(g, rng, 60)
    i1, i2 = i1_and_i2(g)
    found = orbit_likelihood(full(gradiometer.measure(truth, rng, 0.0)), i1 if known == "I1" else None, None)
    true_matrix = np.linalg.inv(gradiometer.K)
    factor = 1.0 if known == "I1" else np.linalg.det(gradiometer.K) ** 0.2
    turn = turn_to(found, true_matrix)
    np.testing.assert_allclose(turn @ found.matrix, factor * true_matrix, atol=1e-7)
    assert found.diagnostics["normalised_determinant"] == pytest.approx(normalised_determinant(i1, i2), abs=1e-8)
    assert any("scale" in words and "unidentified" in words for words in found.verdict) == (known == "neither")
    assert found.nullity == len(found.gauge) == (3 if known == "I1" else 4)


def test_open_directions_have_no_variance():
    rng = np.random.default_rng(8)
    g = dipole_components(50.0)
    measured = full(gauss(random_gradiometer(rng), rotated_components(g, rng, 200), rng))
    for known, open_ in ((i1_and_i2(g), 3), ((None, None), 4)):
        found = orbit_likelihood(measured, *known)
        spread = np.sqrt(np.diag(found.covariance))
        values = np.linalg.eigvalsh(found.covariance / np.outer(spread, spread))
        assert (values[:open_] < 1e-10).all() and values[open_] > 1e-9
    # the convention of the scale: det H is held
    by_determinant = np.concatenate([np.linalg.inv(found.matrix).T.ravel(), np.zeros(5)])
    assert by_determinant @ found.covariance @ by_determinant < 1e-12 * np.trace(found.covariance)


@pytest.mark.parametrize("height", [20.0, 40.0, 60.0, 100.0])
def test_a_hundred_rotations_reach_the_noise(height):
    """METHODS B3: .058-.059 from N = 100 where the floor is .0577, Sui .12.

    27 coefficients from 200 equations add 27 / 500 to the mean square of the same 500 components: 2.7 % to the rms.
    """
    rng = np.random.default_rng(9)
    g = dipole_components(height)
    errors = []
    for _ in range(6):
        gradiometer, truth = random_gradiometer(rng), rotated_components(g, rng, 100)
        measured = gradiometer.measure(truth, rng)
        found = orbit_likelihood(full(measured), *i1_and_i2(g))
        true_matrix = np.linalg.inv(gradiometer.K)
        errors.append(rms(five(found.apply(full(measured))) @ turn_to(found, true_matrix).T - truth))
    assert 0.97 * NOISE_STD < np.mean(errors) < 1.05 * NOISE_STD


def far_off(rng):
    """Axes turned by 20 degrees together, 30 % of scale and a general matrix of 30 % besides."""
    axis = rng.normal(size=3)
    turn = rotation_of_five(Rotation.from_rotvec(np.radians(20) * axis / np.linalg.norm(axis)).as_matrix())
    mixed = rng.normal(size=(5, 5))
    scale = 1 + 0.3 * rng.uniform(-1, 1, 5)
    return Gradiometer(
        scale[:, None] * (np.eye(5) + 0.3 * mixed / np.linalg.norm(mixed, 2)) @ turn, 15 * rng.uniform(-1, 1, 5)
    )


@pytest.mark.parametrize("known", [True, False])
def test_the_maximum_is_found_from_far_away(known):
    rng = np.random.default_rng(10)
    for height, count in ((30.0, 60), (60.0, 150)):
        g = dipole_components(height)
        for _ in range(5):
            gradiometer, truth = far_off(rng), rotated_components(g, rng, count)
            found = orbit_likelihood(full(gauss(gradiometer, truth, rng)), *(i1_and_i2(g) if known else (None, None)))
            assert found.noise_std == pytest.approx(NOISE_STD, rel=0.35)
            assert len(found.verdict) == (1 if known else 2)


def standardised(found, gradiometer, known):
    """Errors of the 30 coefficients over their standard deviations, and whitened in the directions that are known."""
    true_matrix = np.linalg.inv(gradiometer.K)
    true_matrix /= 1 if known else abs(np.linalg.det(true_matrix)) ** 0.2
    true_matrix = rotation_of_five(nearest_in_gauge(true_matrix, np.eye(5))[0]) @ true_matrix
    error = np.concatenate([(found.matrix - true_matrix).ravel(), found.offset + true_matrix @ gradiometer.O])
    spread = np.sqrt(np.diag(found.covariance))
    values, vectors = np.linalg.eigh(found.covariance / np.outer(spread, spread))
    known_ = slice(found.nullity, None)
    return error / spread, (vectors[:, known_].T @ (error / spread)) / np.sqrt(values[known_])


@pytest.mark.parametrize("known", [True, False])
def test_standard_errors_and_intervals_are_true(known):
    """60 series of a hundred rotations; 300 in studies/sui_likelihood.py.

    Of 60 times 27 whitened errors the mean square has a standard deviation of .035, the coverage one of .0055; of the
    30 plain ones, which correlate, some twice that.
    """
    rng = np.random.default_rng(11)
    g = dipole_components(50.0, off_axis(70))
    gradiometer = random_gradiometer(rng)
    given = i1_and_i2(g) if known else (None, None)
    plain, white, shape = [], [], []
    for _ in range(60):
        truth = rotated_components(g, rng, 100)
        found = orbit_likelihood(full(gauss(gradiometer, truth, rng)), *given)
        one, other = standardised(found, gradiometer, known)
        plain.append(one)
        white.append(other)
        off = found.diagnostics["normalised_determinant"] - normalised_determinant(*i1_and_i2(g))
        shape.append(off / found.diagnostics["normalised_determinant_std"])
    for values, tolerance in ((np.array(plain), 2), (np.array(white), 1)):
        assert np.mean(values**2) == pytest.approx(1, abs=0.11 * tolerance)
        assert np.mean(np.abs(values) < 1.96) == pytest.approx(0.95, abs=0.018 * tolerance)
    if not known:
        assert np.std(shape) == pytest.approx(1, abs=0.3)


@pytest.mark.long
def test_many_rotations_near_the_limit_are_unbiased():
    """Plain maximum likelihood is off here by 1.5 standard errors in each direction: its mean square is 3.1."""
    rng = np.random.default_rng(12)
    g = dipole_components(100.0, off_axis(70))
    squares = []
    for _ in range(2):
        gradiometer, truth = random_gradiometer(rng), rotated_components(g, rng, 20000)
        found = orbit_likelihood(full(gauss(gradiometer, truth, rng)), *i1_and_i2(g))
        squares.append(standardised(found, gradiometer, True)[1] ** 2)
    assert np.mean(squares) < 1.6  # 54 squares of unit variance exceed this once in 200


@pytest.mark.long
def test_noise_of_unequal_components_is_weighed():
    rng = np.random.default_rng(13)
    g = dipole_components(40.0)
    mix = np.diag([0.02, 0.3, 0.05, 0.02, 0.1]) @ (np.eye(5) + 0.3 * rng.normal(size=(5, 5)))
    covariance = mix @ mix.T
    errors, white = [], []
    for _ in range(20):
        gradiometer, truth = random_gradiometer(rng), rotated_components(g, rng, 150)
        measured = full(truth @ gradiometer.K.T + gradiometer.O + rng.normal(size=truth.shape) @ mix.T)
        weighed = orbit_likelihood(measured, *i1_and_i2(g), covariance)
        alike = orbit_likelihood(measured, *i1_and_i2(g))
        white.append(standardised(weighed, gradiometer, True)[1])
        true_matrix = np.linalg.inv(gradiometer.K)
        errors.append([rms(turn_to(f, true_matrix) @ f.matrix - true_matrix) for f in (weighed, alike)])
        assert weighed.noise_std == pytest.approx(np.sqrt(np.mean(np.diag(covariance))), rel=0.3)
    better, worse = np.mean(errors, axis=0)
    assert better < 0.8 * worse
    assert np.mean(np.square(white)) == pytest.approx(1, abs=0.2)


def test_spikes_are_left_out():
    rng = np.random.default_rng(14)
    g = dipole_components(50.0)
    gradiometer, truth = random_gradiometer(rng), rotated_components(g, rng, 300)
    measured = gauss(gradiometer, truth, rng)
    spoilt = measured.copy()
    spoilt[[5, 17, 200]] += 1000 * rng.normal(size=(3, 5))
    spoilt[100] += [0.0, 3.0, 0.0, 0.0, 0.0]
    found = orbit_likelihood(full(spoilt), *i1_and_i2(g))
    clean = orbit_likelihood(full(np.delete(measured, [5, 17, 100, 200], axis=0)), *i1_and_i2(g))
    np.testing.assert_allclose(found.matrix, clean.matrix, atol=1e-6)
    assert any("4 of 300 rotations left out" in words for words in found.verdict)
    with_them = orbit_likelihood(full(np.delete(spoilt, [5, 17, 200], axis=0)), *i1_and_i2(g), robust=False)
    assert with_them.noise_std > 1.5 * found.noise_std


def test_better_than_the_paper():
    rng = np.random.default_rng(15)
    g = dipole_components(60.0)
    errors = []
    for _ in range(4):
        gradiometer, truth = random_gradiometer(rng), rotated_components(g, rng, 150)
        measured = full(gradiometer.measure(truth, rng))
        true_matrix = np.linalg.inv(gradiometer.K)
        both = [f(measured, *i1_and_i2(g)) for f in (orbit_likelihood, sui2017)]
        errors.append([rms(turn_to(f, true_matrix) @ f.matrix - true_matrix) for f in both])
    ours, paper = np.mean(errors, axis=0)
    assert ours < paper / 3


# --- what cannot be known ----------------------------------------------------------------------------------


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("noise", [0.0, 1e-5, NOISE_STD])
@pytest.mark.parametrize(
    "height, direction, axis, words",
    [
        (50.0, ON_AXIS, None, "axisymmetric"),
        (50.0, STRAIGHT_ABOVE, (1.0, 2.0, 3.0), "single axis"),
        (100.0, STRAIGHT_ABOVE, (0.0, 0.0, 1.0), "single axis"),
    ],
)
def test_degenerate_sources_are_refused_whatever_the_noise(height, direction, axis, words, noise, known):
    rng = np.random.default_rng(16)
    g = dipole_components(height, direction)
    measured = full(gauss(random_gradiometer(rng), rotated_components(g, rng, 60, axis), rng, noise))
    with pytest.raises(NotEnoughData, match=words):
        orbit_likelihood(measured, *(i1_and_i2(g) if known else (None, None)))


def test_rotations_about_two_axes_that_leave_directions_empty_are_refused():
    """A few orientations, each many times: more rotations than coefficients, fewer than two equations for each."""
    rng = np.random.default_rng(17)
    g = dipole_components(50.0)
    truth = np.repeat(rotated_components(g, rng, 9), 5, axis=0)
    with pytest.raises(NotEnoughData, match=r"do not determine.*directions of them"):
        orbit_likelihood(full(gauss(random_gradiometer(rng), truth, rng)), *i1_and_i2(g))


@pytest.mark.parametrize("known", [True, False])
def test_a_vanishing_determinant_leaves_the_sign_to_the_prior_and_says_so(known):
    rng = np.random.default_rng(18)
    g = dipole_components(50.0, BROADSIDE)
    gradiometer, truth = random_gradiometer(rng), rotated_components(g, rng, 200)
    measured = full(gauss(gradiometer, truth, rng))
    given = i1_and_i2(g) if known else (None, None)
    found = orbit_likelihood(measured, *given)
    assert any("no data tell H from -H" in words for words in found.verdict)
    other = orbit_likelihood(measured, *given, prior=(-np.eye(5)).tolist())
    np.testing.assert_allclose(other.matrix, -found.matrix, atol=1e-4)
    off = orbit_likelihood(
        full(gauss(gradiometer, rotated_components(dipole_components(50.0, off_axis(80)), rng, 200), rng)), None, None
    )
    assert not any("tell H from -H" in words for words in off.verdict)


def test_too_few_rotations_and_too_weak_a_source():
    rng = np.random.default_rng(19)
    g = dipole_components(30.0)
    with pytest.raises(NotEnoughData, match="29 rotations cannot determine 27"):
        orbit_likelihood(full(gauss(random_gradiometer(rng), rotated_components(g, rng, 29), rng)), None, None)
    weak = dipole_components(300.0)
    measured = full(gauss(random_gradiometer(rng), rotated_components(weak, rng, 300), rng))
    with pytest.raises(NotEnoughData, match="too small against a noise"):
        orbit_likelihood(measured, *i1_and_i2(weak))
    with pytest.raises(NotEnoughData, match="nearer to the source"):  # some components do not stand above the noise
        orbit_likelihood(measured, None, None)
    with pytest.raises(NotEnoughData):
        orbit_likelihood(np.repeat(full(g)[None], 100, axis=0), None, None)


def test_invariants_of_another_tensor():
    rng = np.random.default_rng(20)
    g = dipole_components(30.0, off_axis(63))
    measured = full(gauss(random_gradiometer(rng), rotated_components(g, rng, 100), rng))
    i1, i2 = i1_and_i2(g)
    with pytest.raises(DataError, match="check the sign and the units"):
        orbit_likelihood(measured, i1, -i2)
    assert any("check the units" in words for words in orbit_likelihood(measured, 4 * i1, 8 * i2).verdict)
    slightly = orbit_likelihood(measured, i1, 0.999 * i2)
    assert any("ask for a normalised determinant" in words for words in slightly.verdict)
    assert len(orbit_likelihood(measured, i1, i2).verdict) == 1
    with pytest.raises(DataError, match="largest possible"):
        orbit_likelihood(measured, -1.0, 5.0)
    with pytest.raises(UsageError, match="without invariant_1"):
        orbit_likelihood(measured, None, i2)
    with pytest.raises(UsageError, match="sui2017 needs invariant_1 and invariant_2"):
        sui2017(measured, None, None)


def test_the_result_does_not_depend_on_the_frame_of_the_true_tensor():
    """METRIC keeps lengths under rotation; a turned series has the same H but for the turn, which the gauge undoes."""
    rng = np.random.default_rng(21)
    g = dipole_components(50.0)
    gradiometer, truth = random_gradiometer(rng), rotated_components(g, rng, 100)
    turn = rotation_of_five(Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix())
    np.testing.assert_allclose(turn.T @ METRIC @ turn, METRIC, atol=1e-12)
    noise = NOISE_STD * rng.normal(size=truth.shape)
    one, other = (
        orbit_likelihood(full(t @ gradiometer.K.T + gradiometer.O + noise), *i1_and_i2(g))
        for t in (truth, truth @ turn.T)
    )
    assert rms(one.offset - other.offset) < 5 * np.sqrt(np.diag(one.covariance)[25:]).max()
