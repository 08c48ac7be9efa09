"""The algebraic fits: exact on exact data, refused where open, and their bias where the attitudes cover little."""

import numpy as np
import pytest
from paper_setups import directions

from magtensor import NotEnoughData
from magtensor.calibration.quadric import (
    NotAnEllipsoid,
    constant_term_normalised,
    design,
    ellipsoid_of,
    ellipsoid_restricted,
    fit_ellipsoid,
    gradient_normalised,
    nearest_quadrics,
)
from magtensor_methods import chi2017

FITS = [constant_term_normalised, ellipsoid_restricted, gradient_normalised]


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize("axes", [(1.0, 1.0, 1.0), (1.0, 1.0, 0.2), (1.0, 0.3, 0.3), (2.0, 0.9, 0.5)])
def test_exact_ellipsoids_return(fit, axes: tuple[float, float, float]) -> None:
    """Slender ones too: a short axis of a fifth lies far outside what the restriction with k = 4 admits."""
    rng = np.random.default_rng(1)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    points = directions(rng, 40) * np.array(axes) @ turn.T + [0.02, -0.05, 0.03]
    found = ellipsoid_of(fit(points))
    np.testing.assert_allclose(found.shape, turn @ np.diag(1 / np.square(axes)) @ turn.T, atol=1e-8)
    np.testing.assert_allclose(found.offset, [0.02, -0.05, 0.03], atol=1e-9)


@pytest.mark.parametrize("fit", [ellipsoid_restricted, gradient_normalised])
def test_a_shift_of_the_points_shifts_the_centre_alone(fit) -> None:
    rng = np.random.default_rng(2)
    points = directions(rng, 60) + 0.01 * rng.normal(size=(60, 3))
    first, second = ellipsoid_of(fit(points)), ellipsoid_of(fit(points + np.array([3.0, -1.0, 2.0])))
    np.testing.assert_allclose(second.shape, first.shape, atol=1e-7)
    np.testing.assert_allclose(second.offset - first.offset, [3.0, -1.0, 2.0], atol=1e-7)


def test_open_surfaces_are_no_ellipsoids() -> None:
    hyperboloid = np.array([1.0, 1, -1, 0, 0, 0, 0, 0, 0, -1])
    cylinder = np.array([1.0, 1, 0, 0, 0, 0, 0, 0, 0, -1])
    imaginary = np.array([1.0, 1, 1, 0, 0, 0, 0, 0, 0, 1])
    for p in (hyperboloid, cylinder, imaginary):
        with pytest.raises(NotAnEllipsoid):
            ellipsoid_of(p)


@pytest.mark.parametrize("fit", ["ellipsoid", "gradient"])
def test_points_on_a_hyperboloid_are_refused(fit: str) -> None:
    rng = np.random.default_rng(3)
    height, turn = rng.uniform(-1, 1, 200), rng.uniform(0, 2 * np.pi, 200)
    r = np.sqrt(1 + height**2)
    raw = 40_000 * np.column_stack([r * np.cos(turn), r * np.sin(turn), height])
    with pytest.raises(NotEnoughData):
        chi2017(raw, np.full(200, 50_000.0), fit=fit)


def test_field_that_varies_by_a_factor() -> None:
    """As in a coil: the F-normalised fixed point still finds the offset."""
    rng = np.random.default_rng(4)
    field = rng.uniform(30_000, 60_000, 80)
    c, o = np.diag([1.02, 0.97, 1.01]), np.array([900.0, -400, 250])
    found = fit_ellipsoid(field[:, None] * directions(rng, 80) @ c.T + o, field, ellipsoid_restricted)
    np.testing.assert_allclose(found.offset, o, atol=1e-4)
    np.testing.assert_allclose(found.shape, np.linalg.inv(c @ c.T), atol=1e-8)


@pytest.mark.parametrize("rounding", [1e-8, 1e-7])
def test_rounding_that_moves_the_centre_does_not_keep_it_from_settling(rounding: float) -> None:
    """On ill-conditioned samples the fit's own rounding moves the centre by more than the step that counts as none."""
    rng = np.random.default_rng(7)
    field = rng.uniform(45_000, 55_000, 80)
    offset = np.array([20_000.0, -15_000, 10_000])
    raw = field[:, None] * directions(rng, 80) + offset
    noise = np.random.default_rng(8)

    def rounded(x: np.ndarray) -> np.ndarray:
        return ellipsoid_restricted(x) * (1 + rounding * noise.normal(size=10))

    found = fit_ellipsoid(raw, field, rounded)
    np.testing.assert_allclose(found.offset, offset, atol=50 * rounding * 50_000)


def test_a_centre_that_never_rests_is_told() -> None:
    rng = np.random.default_rng(9)
    field = rng.uniform(45_000, 55_000, 80)
    raw = field[:, None] * directions(rng, 80)
    noise = np.random.default_rng(10)

    def restless(x: np.ndarray) -> np.ndarray:
        return ellipsoid_restricted(x + 0.01 * noise.normal(size=3))

    with pytest.raises(NotAnEllipsoid, match="does not settle"):
        fit_ellipsoid(raw, field, restless)


def test_taubin_distance_is_that_of_the_noise() -> None:
    rng = np.random.default_rng(5)
    points = directions(rng, 5000) * [1.0, 0.8, 0.6] + 1e-3 * rng.normal(size=(5000, 3))
    nearest = nearest_quadrics(points)
    assert nearest.distance[0] == pytest.approx(1e-3, rel=0.05)
    row = design(points) @ nearest.coefficients
    assert abs(row.mean()) < 1e-12 * np.abs(nearest.coefficients).max() * 100


def test_gradient_constraint_takes_the_bias() -> None:
    """A cap of 50 deg at 100 nT: the restricted fit is off by several standard deviations, this one is not."""
    rng = np.random.default_rng(6)
    error = {"ellipsoid": [], "gradient": []}
    for _ in range(40):
        unit = directions(rng, 20_000)
        unit = unit[unit[:, 2] > np.cos(np.radians(50))]
        raw = 50_000 * unit + 100 * rng.normal(size=unit.shape)
        for fit, found in error.items():
            found.append(chi2017(raw, np.full(len(raw), 50_000.0), fit=fit, worst_error=1.0).offset[2])
    scatter = np.std(error["gradient"])
    assert abs(np.mean(error["gradient"])) < 4 * scatter / np.sqrt(40) + 0.3 * scatter
    assert abs(np.mean(error["ellipsoid"])) > 2 * abs(np.mean(error["gradient"]))
