"""Between the mathematics of the tensor and the survey's variables: assembles, stores and re-applies."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np

from magtensor.calibration.types import Array, ArrayCalibration
from magtensor.errors import NotEnoughData
from magtensor.survey.model import AXES, Survey, Variable
from magtensor.tensor.assembly import Assembly, unconstrained_assembly
from magtensor.tensor.elements import FIVE_OF_NINE, NINE_OF_FIVE, closure, five, full
from magtensor.tensor.invariants import Invariants, invariants, invariants_std
from magtensor.tensor.uncertainty import TakenOff, component_covariance, mean_field_std, tensor_std

FIVE = ("xx", "xy", "xz", "yy", "yz")
TENSOR = ("time", "row", "column")
NOISE_AND_CALIBRATION = "noise and calibration"  # what the standard deviations hold
INVARIANT_UNITS = Invariants("nT2/m2", "nT3/m3", "nT/m", "nT/m")  # type: ignore[arg-type]  # names, not arrays
_CHUNK = 65536  # samples whose (5, 5) covariances are held at a time


def assembly_variables(assembly: Assembly, position: Array, noise: Array) -> dict[str, Variable]:
    """An assembly as variables of the group `calibration`, all that a later survey needs."""
    facts = {
        "units": "1/m",
        "method": assembly.name,
        "centre_m": np.asarray(assembly.centre, dtype=float),
        "determined": json.dumps(list(assembly.determined)),
        "truncation_order": assembly.truncation_order,
        "notes": json.dumps(list(assembly.notes)),
        "long_name": "tensor = gain : b",
    }
    return noise_variables(noise) | {
        "calibration/row": (("row",), np.array(AXES), {}),
        "calibration/column": (("column",), np.array(AXES), {}),
        "calibration/tensor_gain": (("row", "column", "sensor", "axis"), assembly.gain, facts),
        "calibration/field_gain": (("row", "sensor", "axis"), assembly.field_gain, {"units": "1"}),
        "calibration/position": (("sensor", "axis"), position, {"units": "m"}),
    }  # fmt: skip


def noise_variables(noise: Array) -> dict[str, Variable]:
    """`calibration/noise_std`."""
    attributes = {"units": "nT", "long_name": "white noise of b, from second differences"}
    return {"calibration/noise_std": (("sensor", "axis"), noise, attributes)}


def slow_noise_variables(slow: Array) -> dict[str, Variable]:
    """`calibration/slow_noise_std`, from (3 S,) nT."""
    attributes = {"units": "nT", "long_name": "slow noise of b beside the white one, rms over the calibration's survey"}
    return {"calibration/slow_noise_std": (("sensor", "axis"), slow.reshape(-1, 3), attributes)}


def noise_of_a_sample(calibration: Survey, white: Array) -> Array:
    """(S, 3) nT, the noise of a single sample of b: the white one, and the slow one where it is known."""
    if "calibration/slow_noise_std" not in calibration:
        return white
    return np.hypot(white, calibration.values("calibration/slow_noise_std"))


def stored_assembly(calibration: Survey) -> Assembly:
    """The assembly that `assembly_variables` stored."""
    gain = calibration["calibration/tensor_gain"]
    return Assembly(
        str(gain.attrs["method"]),
        np.asarray(gain.values),
        np.asarray(calibration.values("calibration/field_gain")),
        np.asarray(gain.attrs["centre_m"]),
        tuple(json.loads(gain.attrs["determined"])),
        int(gain.attrs["truncation_order"]),
        tuple(json.loads(gain.attrs["notes"])),
    )


def assembled(
    assembly: Assembly,
    b: Array,
    position: Array,
    noise: Array,
    calibration: ArrayCalibration,
    refinement: tuple[Array, Array, Array] | None = None,
    taken_off: TakenOff | None = None,
) -> dict[str, Variable]:
    """Tensor, mean field, invariants and their standard deviations at every sample.

    Args:
        assembly: the linear map.
        b: (N, S, 3) nT in one common frame.
        position: (S, 3) m.
        noise: (S, 3) nT noise of a sample of b; NaN where unknown, and the deviations then hold the calibration's part
            alone.
        calibration: with its covariance.
        refinement: H (5, 5), D (5,) nT/m of Sui 2017 eq. 9 and their covariance (30, 30), where there is one.
        taken_off: the errors of effects that were corrected before, where they are known.
    """
    symmetric = assembly.symmetrised()
    tensor = symmetric.apply(b)
    covariance = np.diag(noise.ravel() ** 2) if np.isfinite(noise).all() else None
    measured = five(tensor)
    if refinement is not None:
        symmetric = replace(symmetric, gain=_refined_gain(refinement[0], symmetric.gain))
        tensor = symmetric.apply(b) + full(refinement[1])
    std = tensor_std(symmetric, b, noise_covariance=covariance, calibration=calibration, taken_off=taken_off)
    values = np.stack(invariants(tensor), axis=1)
    deviations = np.empty_like(values)
    for start in range(0, len(b), _CHUNK):
        part = slice(start, start + _CHUNK)
        each = component_covariance(
            symmetric, b[part], noise_covariance=covariance, calibration=calibration,
            taken_off=None if taken_off is None else taken_off.at(part),
        )  # fmt: skip
        if refinement is not None:
            own = _refinement_covariance(measured[part], refinement[2])
            each += own
            nine = np.einsum("ka,nab,kb->nk", NINE_OF_FIVE, own, NINE_OF_FIVE).reshape(-1, 3, 3)
            std[part] = np.sqrt(std[part] ** 2 + nine)
        deviations[part] = np.stack(invariants_std(tensor[part], each), axis=1)
    field_std = mean_field_std(assembly, b, noise_covariance=covariance, calibration=calibration, taken_off=taken_off)
    of_field = {"units": "nT", "long_name": "at the centre"}
    of_std = {"units": "nT", "long_name": NOISE_AND_CALIBRATION}
    return (
        tensor_variables(tensor, std)
        | invariant_variables(values, deviations)
        | closure_variables(b, position)
        | {
            "calibrated/mean_field": (("time", "axis"), assembly.field(b), of_field),
            "calibrated/mean_field_std": (("time", "axis"), field_std, of_std),
        }
    )


def _refined_gain(matrix: Array, gain: Array) -> Array:
    out: Array = (NINE_OF_FIVE @ matrix @ FIVE_OF_NINE @ gain.reshape(9, -1)).reshape(gain.shape)
    return out


def _refinement_covariance(measured: Array, covariance: Array) -> Array:
    """(N, 5, 5) of H T5 + D from the covariance of H (row by row) and D."""
    forms = np.zeros((5, 6, 5, 6))
    forms[:, :5, :, :5] = covariance[:25, :25].reshape(5, 5, 5, 5)
    forms[:, :5, :, 5] = covariance[:25, 25:].reshape(5, 5, 5)
    forms[:, 5, :, :5] = covariance[25:, :25].reshape(5, 5, 5)
    forms[:, 5, :, 5] = covariance[25:, 25:]
    z = np.column_stack([measured, np.ones(len(measured))])
    out: Array = np.einsum("ni,aibj,nj->nab", z, forms, z, optimize=True)
    return out


def refinement_variables(matrix: Array, offset: Array, covariance: Array, facts: dict[str, Any]) -> dict[str, Variable]:
    """A refinement as variables of the group `calibration`."""
    names = [f"H_{r}_{c}" for r in FIVE for c in FIVE] + [f"D_{r}" for r in FIVE]
    return {
        "calibration/component": (("component",), np.array(FIVE), {}),
        "calibration/coefficient": (("coefficient",), np.array(names), {}),
        "calibration/tensor_matrix": (("component", "component_"), matrix, {"units": "1"} | facts),
        "calibration/tensor_offset": (("component",), offset, {"units": "nT/m"}),
        "calibration/tensor_covariance": (("coefficient", "coefficient_"), covariance, {}),
    }


def refinement_noise(calibration: Survey) -> float:
    """nT/m, of one component of the tensors that were refined, as the refinement found it."""
    return float(calibration["calibration/tensor_matrix"].attrs["noise_std"])


def stored_refinement(calibration: Survey) -> tuple[Array, Array, Array] | None:
    """What `refinement_variables` stored, if there is one."""
    if "calibration/tensor_matrix" not in calibration:
        return None
    names = ("tensor_matrix", "tensor_offset", "tensor_covariance")
    matrix, offset, covariance = (np.asarray(calibration.values(f"calibration/{n}")) for n in names)
    return matrix, offset, covariance


def closure_variables(b: Array, position: Array) -> dict[str, Variable]:
    """`residual/closure`: trace and asymmetries of the separately measured derivatives, nT/m, as far as measured."""
    try:
        measured = unconstrained_assembly(position).apply(b)
    except NotEnoughData:  # sensors in a plane oblique to the axes measure none of them separately
        return {}
    found = {name: values for name, values in closure(measured).items() if np.isfinite(values).any()}
    if not found:
        return {}
    return {
        "residual/identity": (("identity",), np.array(list(found)), {"long_name": "zero by Maxwell's equations"}),
        "residual/closure": (("time", "identity"), np.stack(list(found.values()), axis=1), {"units": "nT/m"}),
    }


def refined(measured: Array, noise: float, refinement: tuple[Array, Array, Array]) -> dict[str, Variable]:
    """The refined tensor of an instrument that measures gradients itself, its invariants, and their deviations.

    Args:
        measured: (N, 5) nT/m.
        noise: nT/m, of one measured component; NaN where unknown, and the deviations then hold the refinement's part.
        refinement: H (5, 5), D (5,) nT/m and their covariance (30, 30).
    """
    matrix, offset, covariance = refinement
    tensor = full(measured @ matrix.T + offset)
    values = np.stack(invariants(tensor), axis=1)
    own = noise**2 * matrix @ matrix.T if np.isfinite(noise) else np.zeros((5, 5))
    std, deviations = np.empty_like(tensor), np.empty_like(values)
    for start in range(0, len(measured), _CHUNK):
        part = slice(start, start + _CHUNK)
        each = own + _refinement_covariance(measured[part], covariance)
        std[part] = np.sqrt(np.einsum("ka,nab,kb->nk", NINE_OF_FIVE, each, NINE_OF_FIVE)).reshape(-1, 3, 3)
        deviations[part] = np.stack(invariants_std(tensor[part], each), axis=1)
    return tensor_variables(tensor, std) | invariant_variables(values, deviations)


def tensor_variables(tensor: Array, std: Array | None = None) -> dict[str, Variable]:
    """`calibrated/tensor` and, where it is known, `tensor_std`."""
    given: dict[str, Variable] = {
        "calibrated/row": (("row",), np.array(AXES), {}),
        "calibrated/column": (("column",), np.array(AXES), {}),
        "calibrated/tensor": (TENSOR, tensor, {"units": "nT/m", "long_name": "gradient tensor, dB_row/dx_column"}),
    }
    if std is not None:
        attributes = {"units": "nT/m", "long_name": NOISE_AND_CALIBRATION}
        given["calibrated/tensor_std"] = (TENSOR, std, attributes)
    return given


def invariant_variables(values: Array, deviations: Array | None = None) -> dict[str, Any]:
    """`calibrated/invariants` and, where they are known, `invariants_std`."""
    names = np.array(Invariants._fields)
    units = json.dumps(dict(zip(Invariants._fields, INVARIANT_UNITS, strict=True)))
    given: dict[str, Any] = {
        "calibrated/invariant": (("invariant",), names, {"units_of_each": units}),
        "calibrated/invariants": (("time", "invariant"), values, {"units": "see invariant"}),
    }
    if deviations is not None:
        given["calibrated/invariants_std"] = (("time", "invariant"), deviations, {"units": "see invariant"})
    return given
