"""The common rotation from each source: its errors against its own covariance, bounds, refusals, ambiguities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from platforms import EARTH, Platform, level, passes, random_tensors
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from magtensor.calibration.joint import calibrated, fit_joint
from magtensor.calibration.types import ArrayCalibration
from magtensor.errors import DataError, NotEnoughData
from magtensor.frame.attitude import attitude, mirrored_axis, require_consistent, require_unmirrored
from magtensor.frame.calibration_errors import CalibrationErrors, errors_of
from magtensor.frame.earlier import earlier
from magtensor.frame.estimate import CommonRotation, carried, common_rotation
from magtensor.frame.mounting import mounting
from magtensor.frame.sources import Source
from magtensor.frame.symmetry import Symmetry, symmetry
from magtensor.frame.turning import turning
from magtensor.tensor.geometry import standard_geometry

NOISE = 0.15


def small_turns(rng: np.random.Generator, samples: int, deg: float) -> np.ndarray:
    return Rotation.from_rotvec(np.radians(deg) * rng.normal(size=(samples, 3))).as_matrix()


def perfect(sensors: int) -> CalibrationErrors:
    return CalibrationErrors(np.zeros((12 * sensors, 0)), np.zeros((0, sensors, 3, 4)), np.zeros((3, 0)))


def by_symmetry(p: Platform, cal: ArrayCalibration, rng: np.random.Generator, samples: int = 300) -> list[Source]:
    field = np.einsum("nij,i->nj", level(rng, samples), EARTH)
    b = cal.apply(p.in_gradients(random_tensors(rng, samples, 100.0), field))
    return [symmetry(b, p.position, np.full((len(p.position), 3), NOISE), errors_of(cal))]


def by_attitude(p: Platform, cal: ArrayCalibration, rng: np.random.Generator) -> list[Source]:
    attitudes = Rotation.random(300, random_state=rng).as_matrix()
    return [attitude(cal.apply(p.uniform(attitudes)), small_turns(rng, 300, 0.2) @ attitudes, errors_of(cal))]


def by_attitude_and_world(p: Platform, cal: ArrayCalibration, rng: np.random.Generator) -> list[Source]:
    attitudes = level(rng, 300, wobble_deg=20.0)
    b = cal.apply(p.uniform(attitudes))
    return [attitude(b, small_turns(rng, 300, 0.2) @ attitudes, errors_of(cal), EARTH)]


def by_turns(p: Platform, cal: ArrayCalibration, rng: np.random.Generator) -> list[Source]:
    sources: list[Source] = []
    for axis in (0, 2):
        about = np.linspace(0, 6, 300)[:, None] * np.eye(3)[axis] + np.radians(0.1) * rng.normal(size=(300, 3))
        attitudes = (Rotation.from_rotvec([0.6, 0.9, 0.2]) * Rotation.from_rotvec(about)).as_matrix()
        b = cal.apply(p.uniform(attitudes))
        sources.append(turning(b, np.zeros(300, dtype=int), np.eye(3)[axis], errors_of(cal), f"turns about {axis}"))
    return sources


SOURCES = {
    "symmetry": by_symmetry,
    "attitude": by_attitude,
    "attitude and world": by_attitude_and_world,
    "turns": by_turns,
}


def turn_left(p: Platform, cal: ArrayCalibration) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vector (3,) rad by which a calibration's frame still misses the platform's, and its covariance."""
    errors = errors_of(cal)
    true = np.linalg.inv(p.response)
    # the calibrated field of all sensors together: least squares over what each sensor's matrix is turned by
    turns = np.einsum("kij,sjl->skil", GENERATORS, true).reshape(len(true), 3, 9)
    stacked = turns.transpose(0, 2, 1).reshape(-1, 3)
    w = np.linalg.lstsq(stacked, (cal.matrix - true).reshape(-1), rcond=None)[0]
    return w, errors.common @ errors.common.T


GENERATORS = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], float
)


def solved(sources: list[Source], cal: ArrayCalibration, **options: float) -> tuple[CommonRotation, ArrayCalibration]:
    errors = errors_of(cal)
    found = common_rotation(sources, errors, **options)
    return found, carried(cal, errors, found, "platform")


@pytest.mark.parametrize("name", SOURCES)
def test_errors_have_the_variance_that_is_claimed(name):
    """Standardised errors of the whole chain: joint calibration of 60 postures, then the rotation."""
    runs, total = 12, 0.0
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        p = Platform(rng)
        cal = p.calibration(60)
        w, covariance = turn_left(p, solved(SOURCES[name](p, cal, rng), cal)[1])
        total += w @ np.linalg.solve(covariance, w)
    assert chi2.ppf(0.001, 3 * runs) < total < chi2.ppf(0.999, 3 * runs)


@pytest.mark.parametrize(("size", "published"), [(50.0, 1.8), (500.0, 0.18), (3000.0, 0.029)])
def test_symmetry_reaches_the_figures_of_an_independent_study_and_its_own_bound(size, published):
    """METHODS A4.4: planar cross, 6 nT/m noise, 100 samples; a bound from the row of G along the normal."""
    position = standard_geometry("cross", 0.5)
    noise = 6.0 * 0.5 / np.sqrt(2)
    errors, bounds = [], []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        tensors = random_tensors(rng, 100, size)
        turn = Rotation.from_rotvec(0.2 * rng.normal(size=3)).as_matrix()
        b = (np.einsum("nij,sj->nsi", tensors, position) + EARTH) @ turn.T
        b += noise * rng.normal(size=b.shape)
        found = common_rotation([symmetry(b, position, np.full((4, 3), noise), perfect(4))], perfect(4), worst=0.2)
        errors.append(np.linalg.norm(Rotation.from_matrix(found.rotation @ turn).as_rotvec()))
        # the asymmetry of xy has twice the variance of an element and moves by G_z . w
        bounds.append(np.trace(2 * 6.0**2 * np.linalg.inv(tensors[:, 2].T @ tensors[:, 2])))
    rms = np.degrees(np.sqrt(np.mean(np.square(errors))))
    assert rms < 1.1 * published
    # three directions and 25 runs: the rms has a standard deviation of 8 %
    assert rms == pytest.approx(np.degrees(np.sqrt(np.mean(bounds))), rel=0.25)


@pytest.mark.parametrize("shape", ["triangle", "tetrahedron", "hexahedron"])
def test_symmetry_in_any_geometry(shape):
    rng = np.random.default_rng(4)
    position = standard_geometry(shape, 0.6)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.25]).as_matrix()
    b = (np.einsum("nij,sj->nsi", random_tensors(rng, 200, 200.0), position) + EARTH) @ turn.T
    b += NOISE * rng.normal(size=b.shape)
    sensors = len(position)
    found = common_rotation([symmetry(b, position, np.full((sensors, 3), NOISE), perfect(sensors))], perfect(sensors))
    left = Rotation.from_matrix(found.rotation @ turn).as_rotvec()
    assert left @ np.linalg.solve(found.covariance, left) < chi2.ppf(0.999, 3)
    assert len(found.alternatives) == (1 if shape == "triangle" else 0)


def test_the_half_turn_about_the_normal_is_reported():
    rng = np.random.default_rng(1)
    p = Platform(rng)
    cal = p.calibration(200)
    found, _ = solved(by_symmetry(p, cal, rng), cal)
    assert len(found.alternatives) == 1
    assert np.degrees(found.alternatives[0]) == pytest.approx([0, 0, 180], abs=0.5) or np.degrees(
        found.alternatives[0]
    ) == pytest.approx([0, 0, -180], abs=0.5)


def test_a_tetrahedron_needs_no_prior_frame():
    """The symmetry of all nine elements is unique: found also when the frame is turned by 130 deg."""
    rng = np.random.default_rng(2)
    position = standard_geometry("tetrahedron", 0.5)
    turn = Rotation.from_rotvec(np.radians(130) * np.array([0.6, 0.0, 0.8])).as_matrix()
    b = (np.einsum("nij,sj->nsi", random_tensors(rng, 200, 200.0), position) + EARTH) @ turn.T
    b += NOISE * rng.normal(size=b.shape)
    found = common_rotation([symmetry(b, position, np.full((4, 3), NOISE), perfect(4))], perfect(4))
    assert np.degrees(Rotation.from_matrix(found.rotation @ turn).magnitude()) < 0.1


def test_the_whole_covariance_is_that_of_the_parameters():
    """All 48 parameters after the turn, the correlation of rotation and calibration included."""
    runs, total = 8, 0.0
    for seed in range(runs):
        rng = np.random.default_rng(100 + seed)
        p = Platform(rng)
        cal = p.calibration(200)
        _, new = solved(by_symmetry(p, cal, rng), cal)
        true = np.concatenate([np.linalg.inv(p.response).reshape(4, 9), p.offset], axis=1)
        miss = (np.concatenate([new.matrix.reshape(4, 9), new.offset], axis=1) - true).ravel()
        scale = np.sqrt(np.diag(new.covariance))
        total += miss / scale @ np.linalg.solve(new.covariance / np.outer(scale, scale), miss / scale)
    # the calibration's own noise is estimated from 200 samples, so its part has some 1 % more spread than chi2
    assert chi2.ppf(0.0005, 48 * runs) < total < chi2.ppf(0.9995, 48 * runs)


def test_what_was_known_before_and_the_symmetry_add_up():
    runs, total, gains = 6, 0.0, []
    for seed in range(runs):
        rng = np.random.default_rng(200 + seed)
        p = Platform(rng)
        cal = p.calibration(100)
        attitudes = Rotation.random(100, random_state=rng).as_matrix()
        b = cal.apply(p.uniform(attitudes))
        _, first = solved([attitude(b, small_turns(rng, 100, 0.3) @ attitudes, errors_of(cal))], cal)
        again = [earlier(errors_of(first)), *by_symmetry(p, first, rng, samples=40)]
        found, both = solved(again, first)
        w, covariance = turn_left(p, both)
        total += w @ np.linalg.solve(covariance, w)
        assert np.diag(found.covariance) == pytest.approx(np.diag(covariance), rel=1e-6)
        gains.append(np.trace(covariance) / np.trace(turn_left(p, first)[1]))
        assert 0 < found.shares[0] < 1
    assert chi2.ppf(0.001, 3 * runs) < total < chi2.ppf(0.999, 3 * runs)
    assert max(gains) < 0.95


def test_a_declared_sensor_and_axis():
    """A sensor without a misalignment of its own fixes the frame to its tolerance; one axis leaves a turn open."""
    rng = np.random.default_rng(3)
    p = Platform(rng)
    p.response[1] = np.diag([1.01, 0.99, 1.02])
    cal = p.calibration(200)
    errors, tolerance = errors_of(cal), np.radians(0.1)
    found, new = solved([mounting(cal, errors, 1, None, tolerance, "sensor S2")], cal)
    assert new.matrix[1] @ p.response[1] == pytest.approx(np.eye(3), abs=2e-5)
    assert np.degrees(found.std) == pytest.approx([0.1] * 3, rel=0.01)
    axis = mounting(cal, errors, 1, "z", tolerance, "axis z of S2")
    with pytest.raises(NotEnoughData, match="about z of the platform"):
        common_rotation([axis], errors)
    turns = by_turns(p, cal, rng)[:1]
    both = common_rotation([axis, *turns], errors)
    assert np.degrees(Rotation.from_matrix(both.rotation @ found.rotation.T).magnitude()) < 0.1


@pytest.mark.parametrize("name", [*SOURCES, "sensor"])
def test_slopes_are_derivatives(name):
    """Gradient against differences of the cost; response against gradients with a calibration that errs."""
    rng = np.random.default_rng(5)
    p = Platform(rng, common_deg=1.0)
    cal = p.calibration(60)
    errors = errors_of(cal)

    def sources(at: ArrayCalibration) -> list[Source]:
        own = np.random.default_rng(6)
        p.rng = np.random.default_rng(7)
        if name == "sensor":
            return [mounting(at, errors_of(cal), 0, None, 0.01, "S1")]
        return SOURCES[name](p, at, own)

    here = Rotation.from_rotvec([0.02, 0.01, -0.03]).as_matrix()
    for number, source in enumerate(sources(cal)):
        if isinstance(source, Symmetry):  # what the errors take from the slope is of second order in them
            plain: Source = replace(source, errors=perfect(4))
        else:
            plain = source
        slope, step = plain.slope(here, 1.0), 1e-5
        for k, e in enumerate(np.eye(3)):
            there, back = (Rotation.from_rotvec(sign * step * e).as_matrix() @ here for sign in (1, -1))
            difference = (plain.cost(there, 1.0) - plain.cost(back, 1.0)) / (2 * step)
            assert slope.gradient[k] == pytest.approx(difference, rel=1e-4, abs=1e-4 * np.abs(slope.gradient).max())
        best = common_rotation(sources(cal), errors, worst=0.2).rotation
        response = source.slope(best, 1.0).response
        column = int(np.argmax(np.linalg.norm(response, axis=0)))  # others are lost in what the noise leaves
        change = errors.root[:, column].reshape(4, 12)
        wrong = replace(cal, matrix=cal.matrix + change[:, :9].reshape(4, 3, 3), offset=cal.offset + change[:, 9:])
        moved = sources(wrong)[number].slope(best, 1.0).gradient - source.slope(best, 1.0).gradient
        assert moved == pytest.approx(response[:, column], abs=0.1 * np.linalg.norm(response[:, column]))


def test_gradients_below_the_noise_are_refused():
    rng = np.random.default_rng(8)
    p = Platform(rng)
    cal = p.calibration(200)
    b = cal.apply(p.uniform(level(rng, 500)))
    with pytest.raises(NotEnoughData, match="about any axis") as refused:
        common_rotation([symmetry(b, p.position, np.full((4, 3), NOISE), errors_of(cal))], errors_of(cal))
    assert "too small or too few" in refused.value.hint


def test_a_line_in_the_plane_of_a_source_names_what_stays_free():
    """Over a vertical dipole along x all of Gxy and Gyz is zero: a turn about y leaves the tensor symmetric."""
    rng = np.random.default_rng(9)
    p = Platform(rng, common_deg=3.0)
    cal = p.calibration(200)
    level_attitude = np.repeat(np.eye(3)[None], 600, axis=0)
    raw = p.near_dipole(level_attitude, passes(600, (0.0,), height=4.0), np.array([0.0, 0.0, -20.0]))
    with pytest.raises(NotEnoughData, match=r"about y of the platform") as refused:
        common_rotation([symmetry(cal.apply(raw), p.position, np.full((4, 3), NOISE), errors_of(cal))], errors_of(cal))
    assert "another side" in refused.value.hint


def test_curvature_of_the_field_over_the_array_is_not_taken_for_a_turn():
    """Passes at 2 m of a strong dipole: differences miss the gradient by per cents, noise by less; errors stay told."""
    total, runs = 0.0, 8
    for seed in range(runs):
        rng = np.random.default_rng(300 + seed)
        p = Platform(rng)
        cal = p.calibration(200)
        raw = p.near_dipole(level(rng, 1200), passes(1200, (-3.0, 0.0, 1.5, 4.0)), np.array([15.0, 27.0, -60.0]))
        source = symmetry(cal.apply(raw), p.position, np.full((4, 3), NOISE), errors_of(cal))
        w, covariance = turn_left(p, solved([source], cal)[1])
        assert np.degrees(np.linalg.norm(w)) < 1.0
        total += w @ np.linalg.solve(covariance, w)
    assert total < chi2.ppf(0.999, 3 * runs)


def test_too_little_is_refused():
    errors = perfect(4)
    position = standard_geometry("cross", 0.5)
    with pytest.raises(NotEnoughData, match="one line"):
        symmetry(np.zeros((50, 3, 3)), np.array([[0, 0, 0], [1, 0, 0], [2.0, 0, 0]]), np.ones((3, 3)), perfect(3))
    with pytest.raises(NotEnoughData, match="samples"):
        symmetry(np.zeros((5, 4, 3)), position, np.ones((4, 3)), errors)
    with pytest.raises(NotEnoughData, match="noise"):
        symmetry(np.zeros((50, 4, 3)), position, np.full((4, 3), np.nan), errors)
    with pytest.raises(NotEnoughData, match="samples"):
        attitude(np.ones((5, 4, 3)), np.repeat(np.eye(3)[None], 5, axis=0), errors)


def test_an_attitude_that_turns_about_the_vertical_only_leaves_a_turn_free():
    rng = np.random.default_rng(10)
    p = Platform(rng)
    cal = p.calibration(200)
    attitudes = Rotation.from_rotvec(np.linspace(0, 6, 400)[:, None] * [0, 0, 1]).as_matrix()
    with pytest.raises(NotEnoughData, match="about z of the platform"):
        common_rotation([attitude(cal.apply(p.uniform(attitudes)), attitudes, errors_of(cal))], errors_of(cal))


def test_an_attitude_of_the_wrong_sense_is_refused():
    rng = np.random.default_rng(11)
    p = Platform(rng)
    cal = p.calibration(200)
    attitudes = Rotation.random(300, random_state=rng).as_matrix()
    source = attitude(cal.apply(p.uniform(attitudes)), attitudes.swapaxes(1, 2), errors_of(cal))
    found = common_rotation([source], errors_of(cal), worst=1.0)
    with pytest.raises(DataError, match="not that of the sensors"):
        require_consistent(source, found.rotation)


def test_slow_errors_of_the_attitude_widen_the_standard_deviation():
    """A heading that wanders over minutes leaves few independent samples, and the covariance must say so."""
    total, runs = 0.0, 8
    for seed in range(runs):
        rng = np.random.default_rng(400 + seed)
        p = Platform(rng)
        cal = p.calibration(200)
        attitudes = Rotation.random(2000, random_state=rng).as_matrix()
        wander = np.repeat(rng.normal(size=(100, 3)), 20, axis=0)
        wrong = Rotation.from_rotvec(np.radians(0.5) * wander).as_matrix() @ attitudes
        _, new = solved([attitude(cal.apply(p.uniform(attitudes)), wrong, errors_of(cal))], cal)
        w, covariance = turn_left(p, new)
        total += w @ np.linalg.solve(covariance, w)
    assert total < chi2.ppf(0.999, 3 * runs)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_array_that_is_mirrored_as_a_whole_is_told(axis):
    """With the world's field no rotation explains it; without, half a turn does, and every sign is wrong."""
    rng = np.random.default_rng(11 + axis)
    p = Platform(rng, common_deg=3.0)
    attitudes = Rotation.random(200, random_state=rng).as_matrix()
    raw = p.uniform(attitudes)
    raw[:, :, axis] *= -1.0
    fit = fit_joint(raw, np.full(len(raw), np.linalg.norm(EARTH)))
    cal = calibrated(fit)
    b = cal.apply(raw)
    with pytest.raises(DataError, match=f"axis {'xyz'[axis]} of every sensor is inverted"):
        require_unmirrored(attitude(b, attitudes, errors_of(cal), EARTH))
    found, turned = solved([attitude(b, attitudes, errors_of(cal))], cal)
    assert mirrored_axis(found.rotation) == "xyz"[axis]
    seen = turned.apply(raw).mean(axis=1)
    np.testing.assert_allclose(seen, -np.einsum("nij,i->nj", attitudes, EARTH), atol=100.0)


def test_an_array_that_is_not_mirrored_is_not_refused():
    rng = np.random.default_rng(14)
    p = Platform(rng, common_deg=170.0)
    cal = p.calibration(200)
    (source,) = by_attitude_and_world(p, cal, rng)
    require_unmirrored(source)
    assert mirrored_axis(Rotation.from_rotvec([0.0, np.radians(150.0), 0.0]).as_matrix()) is None
