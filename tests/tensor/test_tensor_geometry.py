import numpy as np
import pytest
from dipole import dipole_field, dipole_tensor

from magtensor import DataError, UsageError
from magtensor.tensor.elements import full
from magtensor.tensor.geometry import (
    STANDARD_GEOMETRIES,
    array_centre,
    determination,
    field_polynomials,
    harmonic_design,
    standard_geometry,
    term_names,
)


@pytest.mark.parametrize("name", STANDARD_GEOMETRIES)
def test_standard_geometries_are_centred_and_have_the_baseline(name):
    position = standard_geometry(name, 0.4)
    np.testing.assert_allclose(array_centre(position), 0, atol=1e-15)
    distance = np.linalg.norm(position[:, None] - position[None], axis=-1)
    assert np.isclose(distance, 0.4).any()
    if name not in ("cross", "hexahedron"):  # there the baseline joins opposite sensors
        assert distance[distance > 0].min() == pytest.approx(0.4)


def test_geometry_names_and_baselines_are_checked():
    with pytest.raises(UsageError, match="did you mean cross"):
        standard_geometry("crss", 0.5)
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(UsageError, match="baseline"):
            standard_geometry("cross", wrong)


@pytest.mark.parametrize("wrong", [np.zeros((4, 2)), np.zeros(3), np.zeros((0, 3)), np.full((4, 3), np.nan)])
def test_positions_are_checked(wrong):
    with pytest.raises(DataError, match="position"):
        determination(wrong)


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5])
def test_harmonics_have_neither_divergence_nor_curl(degree):
    names = term_names(degree)
    assert len(names) == 2 * degree + 1
    rng = np.random.default_rng(degree)
    points, h = rng.normal(size=(6, 3)), 1e-4
    slopes = np.stack(
        [(harmonic_design(points + e, degree) - harmonic_design(points - e, degree)) / (2 * h) for e in h * np.eye(3)]
    ).reshape(3, 6, 3, -1)  # (derivative, point, component, term)
    np.testing.assert_allclose(slopes, slopes.transpose(2, 1, 0, 3), atol=1e-6)
    np.testing.assert_allclose(np.einsum("dpdt->pt", slopes), 0, atol=1e-6)


def test_degree_two_is_the_tensor():
    g, rng = np.array([3.0, -1.0, 2.0, 5.0, -4.0]), np.random.default_rng(0)
    points = rng.normal(size=(5, 3))
    assert term_names(2) == ("xx", "xy", "xz", "yy", "yz")
    np.testing.assert_allclose(harmonic_design(points, 2) @ g, (points @ full(g)).ravel(), rtol=1e-13)


def test_coefficients_are_the_derivatives_they_are_named_after():
    for name in (*term_names(3), *term_names(4)):
        for other in (*term_names(3), *term_names(4)):
            if len(other) != len(name):
                continue
            # d^(l-1) B_first / d(rest) at the origin of the polynomials of `name`
            polynomial = field_polynomials(name)["xyz".index(other[0])]
            powers = tuple(other[1:].count(axis) for axis in "xyz")
            factorials = np.prod([float(np.prod(np.arange(1, p + 1))) for p in powers])
            assert polynomial.get(powers, 0.0) * factorials == pytest.approx(float(name == other))


def test_a_dipole_field_is_the_sum_of_its_terms():
    centre, moment, radius = np.array([2.0, -1.0, 3.0]), np.array([50.0, 20.0, -10.0]), 0.05
    rng = np.random.default_rng(1)
    points = rng.normal(size=(40, 3))
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    design = np.hstack([harmonic_design(points, degree) for degree in range(1, 7)])
    scale = np.concatenate([np.full(2 * degree + 1, radius ** (degree - 1)) for degree in range(1, 7)])
    field = dipole_field(centre + points, moment).ravel()
    found = np.linalg.lstsq(design / scale, field, rcond=None)[0] / scale
    np.testing.assert_allclose(full(found[3:8]), dipole_tensor(centre, moment), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("name", STANDARD_GEOMETRIES)
def test_every_standard_geometry_determines_the_tensor(name):
    found = determination(standard_geometry(name, 0.5))
    assert found.undetermined == () and found.reason == "" and found.field
    assert found.combinations == ("Gxx", "Gxy", "Gxz", "Gyy", "Gyz")


def test_a_line_determines_the_derivative_along_it():
    line = np.array([[0.0, 0, 0], [0.5, 0, 0], [1.0, 0, 0]])
    found = determination(line)
    assert found.undetermined == ("Gyy", "Gyz")
    assert found.combinations == ("Gxx", "Gxy", "Gxz")
    assert "no two of them differ along y or z" in found.reason


def test_an_oblique_line_determines_combinations():
    direction = np.array([1.0, 1.0, 0.0])
    found = determination(np.outer([0.0, 0.3, 1.0], direction))
    assert len(found.undetermined) == 5 and len(found.combinations) == 3
    # (Gxx + Gxy, Gxy + Gyy, Gxz + Gyz) and their sums; Gxx - Gyy = first - second
    assert found.combinations == ("Gxx - Gyy", "Gxy + Gyy", "Gxz + Gyz")
    assert "(0.707, 0.707, 0)" in found.reason


@pytest.mark.parametrize(
    "position, words",
    [(np.zeros((1, 3)), "only one sensor"), (np.full((4, 3), 2.0), "4 sensors are all at one place")],
)
def test_no_extent_at_all(position, words):
    found = determination(position)
    assert len(found.undetermined) == 5 and found.combinations == () and words in found.reason


@pytest.mark.parametrize(
    "name, second, third",
    [
        ("cross", 0, 5),
        ("square", 0, 5),
        ("triangle", 5, 5),
        ("tetrahedron", 5, 5),
        ("hexahedron", 0, 5),
        ("cube", 0, 2),
    ],
)
def test_what_stays_determined_beside_higher_terms(name, second, third):
    """On the cube's corners xyz-odd third gradients leave only the diagonal of the tensor ambiguous."""
    position = standard_geometry(name, 0.5)
    assert len(determination(position, "second").undetermined) == second
    assert len(determination(position, "third").undetermined) == third
