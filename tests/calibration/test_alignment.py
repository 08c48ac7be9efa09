"""Alignment of calibrated sensors: accuracy, mirrors, planes, and words for wrong axes."""

import numpy as np
import pytest
from paper_setups import directions

from magtensor import DataError
from magtensor.calibration.alignment import handedness
from magtensor.calibration.axes import axis_faults, describe_axes, nearest_permutation
from magtensor.calibration.rotation import angle_between, from_vector
from magtensor.calibration.types import SensorCalibration
from magtensor_methods import chi2017, eigen_square_root, li2018, pang2013, procrustes, yin2014_linear

FIELD = 50_000.0
ALIGNERS = [procrustes, pang2013, yin2014_linear]
TURNS = [np.zeros(3), np.array([0.02, -0.03, 0.01]), np.array([-0.03, 0.02, 0.05])]


def ideal(noise: float = 1.0) -> SensorCalibration:
    return SensorCalibration(np.eye(3), np.zeros(3), np.zeros((12, 12)), "polar", noise, {"noise_nT": noise})


def outputs(rng: np.random.Generator, unit: np.ndarray, noise: float, faults=None) -> np.ndarray:
    """(N, 3, 3) nT of three ideal sensors turned by TURNS; `faults` are matrices on their output axes."""
    b = []
    for s, turn in enumerate(TURNS):
        seen = FIELD * unit @ from_vector(turn)  # b_sensor = R^T b
        if faults and s in faults:
            seen = seen @ faults[s].T
        b.append(seen + noise * rng.normal(size=seen.shape))
    return np.stack(b, axis=1)


@pytest.mark.parametrize("align", ALIGNERS)
def test_rotations_are_found(align) -> None:
    rng = np.random.default_rng(1)
    array = align(outputs(rng, directions(rng, 500), 1.0), [ideal()] * 3, 0)
    for s, turn in enumerate(TURNS):
        # 1 nT in 50 000 over 500 samples: a microradian
        assert angle_between(from_vector(turn), array.matrix[s]) < 1e-5
    assert array.frame == "sensor 1"
    assert len(array.unobservable) == 1


@pytest.mark.parametrize("reference", [0, 1, 2])
def test_reference_sensor_is_left_alone(reference: int) -> None:
    rng = np.random.default_rng(2)
    array = procrustes(outputs(rng, directions(rng, 50), 1.0), [ideal()] * 3, reference)
    np.testing.assert_array_equal(array.matrix[reference], np.eye(3))
    assert array.frame == f"sensor {reference + 1}"


def test_pang_ends_where_procrustes_does() -> None:
    rng = np.random.default_rng(3)
    b = outputs(rng, directions(rng, 40), 300.0)
    first, second = procrustes(b, [ideal(300)] * 3, 0), pang2013(b, [ideal(300)] * 3, 0)
    np.testing.assert_allclose(first.matrix, second.matrix, atol=1e-9)
    np.testing.assert_allclose(first.covariance, second.covariance, rtol=1e-5, atol=1e-15)


def test_linear_elements_are_noisier() -> None:
    rng = np.random.default_rng(4)
    errors = {align: [] for align in (procrustes, yin2014_linear)}
    for _ in range(60):
        b = outputs(rng, directions(rng, 50), 50.0)
        for align, found in errors.items():
            found.append(angle_between(from_vector(TURNS[2]), align(b, [ideal(50)] * 3, 0).matrix[2]))
    assert np.mean(np.square(errors[yin2014_linear])) > 1.5 * np.mean(np.square(errors[procrustes]))


@pytest.mark.parametrize("align", ALIGNERS)
@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (np.diag([1.0, -1, 1]), "the y axis of sensor 3 is inverted against sensor 1"),
        (np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]), "the x and y axes of sensor 3 are swapped against sensor 1"),
        (-np.eye(3), "the x, y and z axes of sensor 3 are inverted"),
    ],
)
def test_mirrored_axes_are_refused_by_name(align, fault: np.ndarray, words: str) -> None:
    rng = np.random.default_rng(5)
    b = outputs(rng, directions(rng, 60), 1.0, {2: fault})
    with pytest.raises(DataError, match=words):
        align(b, [ideal()] * 3, 0)


def test_a_mirrored_reference_is_named_itself() -> None:
    rng = np.random.default_rng(6)
    b = outputs(rng, directions(rng, 60), 1.0, {0: np.diag([1.0, 1, -1])})
    with pytest.raises(DataError, match="the z axis of sensor 1 is inverted against the other sensors"):
        procrustes(b, [ideal()] * 3, 0)


def test_a_mirror_behind_the_scalar_step_is_seen() -> None:
    """Scalar calibration is blind to the inverted axis: |b| is right, the frame is not."""
    rng = np.random.default_rng(7)
    raw = outputs(rng, directions(rng, 80), 1.0, {1: np.diag([-1.0, 1, 1])}) * [1.03, 0.98, 1.01]
    field = np.full(80, FIELD)
    for method in (chi2017, eigen_square_root):
        fits = [method(raw[:, s], field) for s in range(3)]
        assert max(f.residual_rms for f in fits) < 2
        b = np.stack([f.apply(raw[:, s]) for s, f in enumerate(fits)], axis=1)
        with pytest.raises(DataError, match="the x axis of sensor 2 is inverted"):
            procrustes(b, fits, 0)
    with pytest.raises(DataError, match="the x axis of sensor 2 is inverted"):
        li2018(raw, field)


def test_field_in_a_plane_leaves_the_handedness_open() -> None:
    rng = np.random.default_rng(8)
    turn = rng.uniform(0, 2 * np.pi, 300)
    unit = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(300)])
    b = outputs(rng, unit, 1.0)
    array = procrustes(b, [ideal()] * 3, 0)
    assert np.linalg.det(array.matrix[1]) == pytest.approx(1)
    assert "handedness of sensors 2, 3" in array.unobservable[1]
    assert angle_between(from_vector(TURNS[1]), array.matrix[1]) < 1e-4


def test_handedness_is_decided_by_noise_not_by_sign() -> None:
    rng = np.random.default_rng(9)
    for _ in range(20):
        turn = rng.uniform(0, 2 * np.pi, 50)
        plane = FIELD * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(50)])
        seen = handedness(plane + rng.normal(size=plane.shape), plane + rng.normal(size=plane.shape))
        assert seen.undetermined and not seen.mirrored


def test_a_sensor_turned_by_right_angles_is_described_not_refused() -> None:
    turned = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    words = describe_axes(turned @ from_vector(np.array([0.05, 0.1, 0])), "S3", "S1")
    assert words == "S3 is mounted turned against S1: y along +x, x along -y, z along +z of S1"
    assert describe_axes(from_vector(np.array([0.1, -0.2, 0.1])), "S3", "S1") == ""


def test_axis_faults_name_each_sensor() -> None:
    maps = np.array([np.eye(3), np.diag([1.0, 1, -1]), np.eye(3), [[0, 1.0, 0], [1, 0, 0], [0, 0, 1]]])
    assert axis_faults(maps, 0, ["A", "B", "C", "D"]) == (
        "the z axis of B is inverted against A",
        "the x and y axes of D are swapped against A",
    )
    assert axis_faults(np.array([np.eye(3)] * 3), 0, ["A", "B", "C"]) == ()


def test_nearest_permutation_of_a_tilted_one() -> None:
    p = np.array([[0.0, 0, -1], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(nearest_permutation(p @ from_vector(np.array([0.2, 0.3, -0.1]))), p)
