import numpy as np
import pytest
from dipole import dipole_field, dipole_tensor

from magtensor import DataError, NotEnoughData
from magtensor.calibration.types import ArrayCalibration
from magtensor.components import component_of
from magtensor.tensor.assembly import NOT_SYMMETRISED, least_squares_assembly, unconstrained_assembly
from magtensor.tensor.elements import closure, five, full, separate
from magtensor.tensor.geometry import STANDARD_GEOMETRIES, standard_geometry
from magtensor.tensor.uncertainty import (
    component_covariance,
    mean_field_std,
    noise_covariance_of_components,
    noise_tensor_std,
    tensor_std,
)
from magtensor.tensors import closure_variables
from magtensor_methods.tensor_cross import chi2017_cross, li2018_cross
from magtensor_methods.tensor_least_squares import least_squares

UNIFORM = np.array([20000.0, -5000.0, 42000.0])


def linear_field(position, tensors, centre=None):
    """(N, S, 3) nT of a field that is UNIFORM at the centre and has the tensors (N, 3, 3)."""
    r = position - (position.mean(axis=0) if centre is None else centre)
    return UNIFORM + np.einsum("nij,sj->nsi", tensors, r)


def nested_crosses():
    return np.vstack([standard_geometry("cross", 0.5), standard_geometry("cross", 1.0)])


@pytest.mark.parametrize("name", STANDARD_GEOMETRIES)
@pytest.mark.parametrize("order", ["gradient", "second"])
def test_a_linear_field_is_recovered_exactly(name, order):
    rng = np.random.default_rng(0)
    position = standard_geometry(name, 0.37) + np.array([3.0, -2.0, 1.0])
    if order == "second" and name in ("triangle", "tetrahedron"):
        with pytest.raises(NotEnoughData, match="second gradient"):
            least_squares_assembly(position, None, order)
        return
    tensors = full(rng.normal(size=(20, 5)) * 500)
    mix = rng.normal(size=(3 * len(position),) * 2)
    for noise in (None, mix @ mix.T + np.eye(len(mix))):
        assembly = least_squares_assembly(position, noise, order)
        b = linear_field(position, tensors)
        np.testing.assert_allclose(assembly.apply(b), tensors, atol=1e-8)
        np.testing.assert_allclose(assembly.field(b), np.broadcast_to(UNIFORM, (20, 3)), rtol=1e-12)
        np.testing.assert_allclose(assembly.centre, [3, -2, 1])
        assert assembly.symmetric and len(assembly.determined) == 9


def test_least_squares_minimises_the_weighted_residual():
    """Against numpy's own solution of the whitened system."""
    rng = np.random.default_rng(1)
    position = standard_geometry("tetrahedron", 0.5)
    mix = rng.normal(size=(12, 12))
    covariance = mix @ mix.T + np.eye(12)
    b = rng.normal(size=(4, 3))
    columns = [np.tile(e, 4) for e in np.eye(3)] + [(position @ full(e)).ravel() for e in np.eye(5)]
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    expected = np.linalg.lstsq(whiten @ np.column_stack(columns), whiten @ b.ravel(), rcond=None)[0]
    assembly = least_squares_assembly(position, covariance)
    np.testing.assert_allclose(five(assembly.apply(b)), expected[3:], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(assembly.field(b), expected[:3], rtol=1e-9)


def axial_error(assembly, position, distance):
    """Relative error of Gxx from a dipole pointing along x at `distance` on the x axis."""
    moment, place = np.array([100.0, 0, 0]), np.array([distance, 0, 0])
    truth = dipole_tensor(place, moment)
    found = assembly.apply(dipole_field(place + position, moment)[None])[0]
    return (found - truth)[0, 0] / truth[0, 0]


def test_finite_baseline_error_of_an_on_axis_dipole():
    """d^2/24 B'''/B' + d^4/1920 B'''''/B' for B ~ r^-3: the pair on the axis reads too much by .83 (d/r)^2."""
    d = 0.5
    position = standard_geometry("cross", d)
    assembly = chi2017_cross(position, None)
    assert assembly.truncation_order == 2
    for ratio in (10, 20, 40):
        law = 5 / 6 / ratio**2 + 7 / 16 / ratio**4
        assert axial_error(assembly, position, ratio * d) == pytest.approx(law, rel=1 / ratio**4)


def test_third_order_terms_remove_the_finite_baseline_error():
    position = nested_crosses()
    plain, third = least_squares_assembly(position), least_squares_assembly(position, None, "third")
    assert (plain.truncation_order, third.truncation_order) == (2, 4)
    near = axial_error(plain, position, 10.0), axial_error(third, position, 10.0)
    far = axial_error(plain, position, 20.0), axial_error(third, position, 20.0)
    assert abs(near[1]) < abs(near[0]) / 100
    assert near[0] / far[0] == pytest.approx(4, rel=0.02) and near[1] / far[1] == pytest.approx(16, rel=0.05)
    cost = noise_tensor_std(third, np.eye(24)) / noise_tensor_std(plain, np.eye(24))
    assert (cost > 1).all()  # what is fitted beside the tensor is paid in noise


def test_triangle_is_of_first_order_only_and_the_square_of_second():
    assert least_squares_assembly(standard_geometry("triangle", 1.0)).truncation_order == 1
    assert least_squares_assembly(standard_geometry("square", 1.0)).truncation_order == 2
    tetrahedron = standard_geometry("tetrahedron", 0.5)
    errors = []
    for distance in (10.0, 20.0):
        place, moment = np.array([distance, 0.3 * distance, 0.1 * distance]), np.array([10.0, 30.0, -20.0])
        truth = dipole_tensor(place, moment)
        found = least_squares_assembly(tetrahedron).apply(dipole_field(place + tetrahedron, moment))
        errors.append(np.linalg.norm(found - truth) / np.linalg.norm(truth))
    order = least_squares_assembly(tetrahedron).truncation_order
    assert errors[0] / errors[1] == pytest.approx(2**order, rel=0.1)


def test_fields_of_another_array_are_refused():
    assembly = least_squares_assembly(standard_geometry("cross", 0.5))
    with pytest.raises(DataError, match="4 sensors"):
        assembly.apply(np.zeros((10, 5, 3)))


@pytest.mark.parametrize(
    "position, words",
    [
        ([[0, 0, 0], [0.5, 0, 0]], "Gyy, Gyz cannot be determined: the 2 sensors lie on one line"),
        ([[0, 0, 0]], "there is only one sensor"),
        ([[0, 0, 0.1 * k] for k in range(5)], "no two of them differ along x or y"),
        ([[1, 1, 1]] * 4, "all at one place"),
        ([[0, 0, 0], [0, 0, 0], [1, 2, 3], [1, 2, 3]], "on one line, along"),
    ],
)
def test_a_geometry_that_cannot_is_refused_by_component(position, words):
    with pytest.raises(NotEnoughData, match="three sensors that do not lie on one line") as refused:
        least_squares(np.array(position, dtype=float), None)
    assert words in str(refused.value) and "cannot be determined" in str(refused.value)


def test_order_too_high_is_refused_with_what_remains():
    with pytest.raises(NotEnoughData) as refused:
        least_squares(standard_geometry("cube", 0.5), None, highest_order="third")
    assert str(refused.value).startswith("position: Gxx, Gyy cannot be determined beside the terms up to the third")
    assert "only Gxy, Gxz, Gyz can be" in str(refused.value) and "lower highest_order" in str(refused.value)


def test_a_field_that_curvature_hides_is_noted():
    assembly = least_squares(standard_geometry("cross", 0.5), None, highest_order="second")
    assert any("linear field" in note for note in assembly.notes)
    assert least_squares(standard_geometry("cube", 0.5), None, highest_order="second").notes == ()


def test_duplicate_sensors_are_noted():
    position = np.vstack([standard_geometry("triangle", 0.5), standard_geometry("triangle", 0.5)[:1]])
    assert "sensors 1 and 4 share one position" in least_squares(position, None).notes


@pytest.mark.parametrize(
    "covariance", [np.eye(5), np.zeros((12, 12)), np.full((12, 12), np.nan), np.triu(np.ones((12, 12))), -np.eye(12)]
)
def test_impossible_noise_covariances_are_refused(covariance):
    with pytest.raises(DataError, match="noise covariance"):
        least_squares_assembly(standard_geometry("cross", 0.5), covariance)


def test_the_cross_formulas_are_the_differences_of_the_papers():
    rng = np.random.default_rng(2)
    d, b = 0.4, rng.normal(size=(6, 4, 3))
    position = standard_geometry("cross", d)
    one, two, three, four = b.transpose(1, 0, 2)
    x, y, z = range(3)
    chi, li = chi2017_cross(position, None), li2018_cross(position, None, average=False)
    for assembly in (chi, li):
        found = separate(assembly.apply(b))
        assert not assembly.symmetric and NOT_SYMMETRISED in assembly.notes
        np.testing.assert_allclose(found["Bxx"], (one - three)[:, x] / d)
        np.testing.assert_allclose(found["Bxy"], (two - four)[:, x] / d)
        np.testing.assert_allclose(found["Byx"], (one - three)[:, y] / d)
        np.testing.assert_allclose(found["Bxz"], (one - three)[:, z] / d)
        np.testing.assert_allclose(found["Byy"], (two - four)[:, y] / d)
        np.testing.assert_allclose(found["Byz"], (two - four)[:, z] / d)
        np.testing.assert_allclose(closure(assembly.apply(b))["trace"], 0, atol=1e-12)
    averaged = li2018_cross(position, None)
    assert averaged.symmetric and averaged.notes == ()
    np.testing.assert_allclose(separate(averaged.apply(b))["Bxy"], ((two - four)[:, x] + (one - three)[:, y]) / (2 * d))
    np.testing.assert_allclose(averaged.apply(b), chi.symmetrised().apply(b))
    np.testing.assert_allclose(averaged.field(b), b.mean(axis=1))


def test_the_cross_formula_is_the_least_squares_solution_of_a_cross():
    position = standard_geometry("cross", 0.5)
    np.testing.assert_allclose(li2018_cross(position, None).gain, least_squares(position, None).gain, atol=1e-12)


@pytest.mark.parametrize(
    "position, words",
    [
        (standard_geometry("square", 0.5), "sensor 1 lies at"),
        (standard_geometry("cross", 0.5)[[1, 0, 2, 3]], "not the cross"),
        (standard_geometry("cross", 0.5)[::-1], "not the cross"),
        (standard_geometry("cross", 0.5) * [1, 1.2, 1], "not the cross"),
        (standard_geometry("hexahedron", 0.5), "this array has 6"),
        (np.zeros((4, 3)), "not the cross"),
    ],
)
def test_cross_formulas_refuse_what_is_no_cross(position, words):
    for formula in (chi2017_cross, li2018_cross):
        with pytest.raises(DataError, match=words):
            formula(position, None)


def test_a_cross_may_be_placed_anywhere_and_be_a_millimetre_off():
    position = standard_geometry("cross", 0.5) + np.array([1.0, 2.0, 3.0])
    position[1, 0] += 0.001
    assert chi2017_cross(position, None).name == "chi2017_cross"


def test_unconstrained_gives_what_must_vanish():
    rng = np.random.default_rng(3)
    b = rng.normal(size=(5, 4, 3))
    cross = unconstrained_assembly(standard_geometry("cross", 0.5))
    found = closure(cross.apply(b))
    np.testing.assert_allclose(found["Bxy - Byx"], ((b[:, 1] - b[:, 3])[:, 0] - (b[:, 0] - b[:, 2])[:, 1]) / 0.5)
    assert np.isnan(found["trace"]).all() and np.isnan(found["Bxz - Bzx"]).all()
    assert cross.determined == ("Gxx", "Gxy", "Gyx", "Gyy", "Gzx", "Gzy")

    position = standard_geometry("tetrahedron", 0.5)
    anything = rng.normal(size=(1, 3, 3))
    measured = unconstrained_assembly(position).apply(linear_field(position, anything))
    np.testing.assert_allclose(measured, anything, atol=1e-9)
    with pytest.raises(NotEnoughData):
        unconstrained_assembly(np.outer([0, 1, 2], [1.0, 1.0, 1.0]))


def test_methods_are_marked_for_the_stage():
    for function in (least_squares, chi2017_cross, li2018_cross):
        assert component_of(function).step == "assemble_tensor"
    assert set(component_of(least_squares).options.model_fields) == {"highest_order"}


# --- uncertainty -------------------------------------------------------------------------------------------


def test_only_gxy_gains_from_a_planar_cross():
    """Two estimates of Gxy are averaged, the others stand alone: METHODS A4.11."""
    position, noise = standard_geometry("cross", 0.5), np.eye(12) * 0.3**2
    single = 0.3 * np.sqrt(2) / 0.5
    std = noise_tensor_std(least_squares_assembly(position), noise)
    np.testing.assert_allclose(std[[0, 0, 1, 1], [0, 2, 1, 2]], single)
    assert std[0, 1] == pytest.approx(single / np.sqrt(2))
    assert std[2, 2] == pytest.approx(single * np.sqrt(2))
    np.testing.assert_allclose(noise_tensor_std(chi2017_cross(position, None), noise)[:2], single)


def test_noise_covariance_agrees_with_monte_carlo():
    rng = np.random.default_rng(4)
    position = standard_geometry("tetrahedron", 0.4)
    mix = rng.normal(size=(4, 3, 3))
    per_sensor = mix @ mix.transpose(0, 2, 1) * 0.1
    assembly = least_squares_assembly(position, per_sensor)
    whole = np.zeros((12, 12))
    for s in range(4):
        whole[3 * s : 3 * s + 3, 3 * s : 3 * s + 3] = per_sensor[s]
    draws = rng.multivariate_normal(np.zeros(12), whole, 40000).reshape(-1, 4, 3)
    sampled = five(assembly.apply(draws))
    predicted = noise_covariance_of_components(assembly, per_sensor)
    spread = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    np.testing.assert_allclose(np.cov(sampled.T) / spread, predicted / spread, atol=0.03)
    np.testing.assert_allclose(assembly.apply(draws).std(axis=0), noise_tensor_std(assembly, whole), rtol=0.02)


def test_weights_beat_equal_weights_when_one_sensor_is_noisy():
    position = standard_geometry("cube", 0.5)
    noise = np.diag(np.repeat([1.0] * 7 + [100.0], 3))
    weighted = noise_tensor_std(least_squares_assembly(position, noise), noise)
    equal = noise_tensor_std(least_squares_assembly(position), noise)
    assert (weighted < 0.6 * equal).all()


def random_calibration(rng, sensors):
    matrix = np.eye(3) + 0.03 * rng.normal(size=(sensors, 3, 3))
    scale = np.tile([1e-5] * 9 + [0.5] * 3, sensors)
    mix = rng.normal(size=(12 * sensors, 12 * sensors)) / np.sqrt(12 * sensors)
    covariance = scale[:, None] * (mix @ mix.T + 0.2 * np.eye(12 * sensors)) * scale
    return ArrayCalibration(matrix, 50.0 * rng.normal(size=(sensors, 3)), covariance, "platform")


@pytest.mark.parametrize("name", ["cross", "cube"])
def test_calibration_covariance_agrees_with_monte_carlo_and_adds_to_noise(name):
    rng = np.random.default_rng(5)
    position = standard_geometry(name, 0.5)
    sensors = len(position)
    calibration = random_calibration(rng, sensors)
    assembly = least_squares_assembly(position)
    directions = rng.normal(size=(5, 3))
    b = np.repeat(50000 * directions[:, None] / np.linalg.norm(directions, axis=1)[:, None, None], sensors, axis=1)
    raw = np.einsum("sij,nsj->nsi", np.linalg.inv(calibration.matrix), b) + calibration.offset
    draws = rng.multivariate_normal(np.zeros(12 * sensors), calibration.covariance, 4000).reshape(-1, sensors, 12)
    fields = [
        np.einsum("sij,nsj->nsi", calibration.matrix + p[:, :9].reshape(-1, 3, 3), raw - calibration.offset - p[:, 9:])
        for p in draws
    ]
    sampled = np.stack([five(assembly.apply(field)) for field in fields])
    predicted = component_covariance(assembly, b, calibration=calibration)
    for n in range(5):
        spread = np.sqrt(np.outer(np.diag(predicted[n]), np.diag(predicted[n])))
        np.testing.assert_allclose(np.cov(sampled[:, n].T) / spread, predicted[n] / spread, atol=0.08)
    noise = np.eye(3 * sensors) * 0.2
    both = component_covariance(assembly, b, noise_covariance=noise, calibration=calibration)
    np.testing.assert_allclose(both, predicted + noise_covariance_of_components(assembly, noise))
    std = tensor_std(assembly, b, noise_covariance=noise, calibration=calibration)
    rows, columns = [0, 0, 0, 1, 1], [0, 1, 2, 1, 2]
    np.testing.assert_allclose(std[:, rows, columns], np.sqrt(np.einsum("naa->na", both)), rtol=1e-8)
    np.testing.assert_allclose(std, std.transpose(0, 2, 1))
    of_field = mean_field_std(assembly, b, calibration=calibration)
    np.testing.assert_allclose(np.std([assembly.field(field) for field in fields], axis=0), of_field, rtol=0.06)
    noisy = mean_field_std(assembly, b, noise_covariance=noise, calibration=calibration)
    np.testing.assert_allclose(
        noisy**2 - of_field**2, 0.2 * np.sum(assembly.field_gain**2, axis=(1, 2)) * np.ones((5, 1))
    )
    plain = tensor_std(chi2017_cross(position, None), b, calibration=calibration) if name == "cross" else None
    if plain is not None:
        assert not np.allclose(plain[:, 0, 1], plain[:, 1, 0])  # Bxy and Byx come from different sensors


def test_uncertainty_without_a_covariance_is_unknown_not_zero():
    rng = np.random.default_rng(6)
    assembly, calibration = least_squares_assembly(standard_geometry("cross", 0.5)), random_calibration(rng, 4)
    unknown = ArrayCalibration(
        calibration.matrix, calibration.offset, np.full_like(calibration.covariance, np.nan), "platform"
    )
    b = 50000 * rng.normal(size=(3, 4, 3))
    assert np.isnan(tensor_std(assembly, b, noise_covariance=np.eye(12), calibration=unknown)).all()
    b[1] = np.nan
    std = tensor_std(assembly, b, calibration=calibration)
    assert np.isnan(std[1]).all() and np.isfinite(std[[0, 2]]).all()
    with pytest.raises(DataError, match=r"3 sensors.*\n.*4 sensors"):
        tensor_std(assembly, b, calibration=random_calibration(rng, 3))


def test_pieces_of_a_long_record_agree_with_the_whole():
    rng = np.random.default_rng(7)
    assembly, calibration = least_squares_assembly(standard_geometry("cross", 0.5)), random_calibration(rng, 4)
    b = 50000 * rng.normal(size=(40000, 4, 3))
    std = tensor_std(assembly, b, calibration=calibration)
    pick = rng.integers(0, len(b), 20)
    np.testing.assert_allclose(std[pick], tensor_std(assembly, b[pick], calibration=calibration), rtol=1e-9)


def test_an_oblique_plane_has_a_tensor_and_no_closure() -> None:
    """Three sensors in a plane that is oblique to all axes determine the tensor, and no derivative alone."""
    position = np.array([[0.35, 0.0, 0.0], [-0.2, 0.3, 0.0], [-0.2, -0.3, 0.05]])
    assert closure_variables(np.zeros((4, 3, 3)), position) == {}
