"""The rotation that scalar calibration leaves free: how well it comes out, and what it does to a tensor.

    python studies/common_rotation.py > docs/common_rotation.md

First the angle recovered from the symmetry of the tensor alone, at the sizes of METHODS A4.4. Then the whole chain on
simulated files: calibration in a uniform field by recipes/common_rotation.yaml, `magtensor apply` on lines past two
dipoles, the tensor's error before and after `--refine-rotation`, and with an attitude in the calibration survey.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import io
import tempfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from magtensor.cli import status_of
from magtensor.frame.calibration_errors import CalibrationErrors
from magtensor.frame.estimate import common_rotation
from magtensor.frame.symmetry import symmetry
from magtensor.result import open_result
from magtensor.simulate import simulate, write
from magtensor.tensor.geometry import standard_geometry

RECIPE = Path(__file__).parents[1] / "recipes" / "common_rotation.yaml"
PUBLISHED = {(50, 100): 1.8, (50, 1000): 0.54, (500, 100): 0.18, (500, 1000): 0.054, (3000, 100): 0.029,
             (3000, 1000): 0.009}  # fmt: skip
RUNS = {"cross": 120, "triangle": 30, "tetrahedron": 30}
BASELINE, TENSOR_NOISE = 0.5, 6.0  # m, nT/m
FIELD = np.array([2000.0, 18000.0, -45000.0])


def random_tensors(rng: np.random.Generator, samples: int, size: float) -> np.ndarray:
    """(N, 3, 3) nT/m with five independent normal components."""
    c = size * rng.normal(size=(5, samples))
    rows = [[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], -c[0] - c[3]]]
    return np.moveaxis(np.array(rows), -1, 0)


def recovered(shape: str, size: float, samples: int) -> tuple[float, float, float]:
    """RMS in deg of the angle that is left, of the claimed standard deviation, and mean square standardised error."""
    position = standard_geometry(shape, BASELINE)
    sensors = len(position)
    nothing = CalibrationErrors(np.zeros((12 * sensors, 0)), np.zeros((0, sensors, 3, 4)), np.zeros((3, 0)))
    noise = TENSOR_NOISE * BASELINE / np.sqrt(2)
    left, claimed, standardised = [], [], []
    for seed in range(RUNS[shape]):
        rng = np.random.default_rng(seed)
        turn = Rotation.from_rotvec(np.radians(15) * rng.normal(size=3)).as_matrix()
        b = (np.einsum("nij,sj->nsi", random_tensors(rng, samples, size), position) + FIELD) @ turn.T
        b += noise * rng.normal(size=b.shape)
        source = symmetry(b, position, np.full((sensors, 3), noise), nothing)
        found = common_rotation([source], nothing, worst=0.3)
        w = Rotation.from_matrix(found.rotation @ turn).as_rotvec()
        left.append(w @ w)
        claimed.append(np.trace(found.covariance))
        standardised.append(w @ np.linalg.solve(found.covariance, w) / 3)
    return (
        float(np.degrees(np.sqrt(np.mean(left)))),
        float(np.degrees(np.sqrt(np.mean(claimed)))),
        float(np.mean(standardised)),
    )


def scenario(seed: int, tilt_deg: tuple[float, float, float]) -> dict[str, Any]:
    """A cross whose sensors are all turned by about `tilt_deg`, tumbling in a uniform field."""
    rng = np.random.default_rng(seed)
    angles = np.radians(tilt_deg) + np.radians(0.5) * rng.normal(size=(4, 3))
    sensors = [
        {
            "scale": (1 + 0.01 * rng.normal(size=3)).tolist(),
            "bias_nT": (50 * rng.normal(size=3)).tolist(),
            "angles": {"convention": "chi2017"}
            | dict(zip(("psi_rad", "phi_rad", "theta_rad"), (0.005 * rng.normal(size=3)).tolist(), strict=True))
            | dict(zip(("alpha_rad", "beta_rad", "gamma_rad"), a.tolist(), strict=True)),
        }
        for a in angles
    ]
    return {
        "title": "tumbling in a uniform field",
        "seed": seed,
        "rate_Hz": 10.0,
        "instrument": {
            "seed": seed,
            "array": {"shape": "cross", "baseline_m": BASELINE},
            "errors": sensors,
            "noise": {"white_sd_nT": 0.15, "flicker_nT_per_rtHz": 0.01},
        },
        "motion": {"type": "tumbling", "duration_s": 600.0, "rate_rms_deg_s": 15.0, "rate_time_s": 5.0},
        "field": {"earth": {"total_field_nT": 49500.0, "inclination_deg": 66.0, "declination_deg": 4.0}},
        "base_station": {"rate_Hz": 0.5, "noise_sd_nT": 0.1},
    }


def lines(tumbling: dict[str, Any], height: float) -> dict[str, Any]:
    """The same instrument on eight lines past two dipoles 1.5 and 2 m below the ground."""
    changed = copy.deepcopy(tumbling)
    changed |= {"title": "lines", "seed": tumbling["seed"] + 100}
    changed["motion"] = {
        "type": "survey_lines", "lines": 8, "length_m": 24.0, "spacing_m": 1.5, "speed_m_s": 1.0, "height_m": height,
        "azimuth_deg": 20.0, "turn_s": 8.0, "wobble_deg": 3.0, "wobble_time_s": 2.0,
    }  # fmt: skip
    changed["field"]["dipoles"] = [
        {"position_m": [5.0, 7.0, -1.5], "moment_Am2": [3.0, 20.0, -40.0]},
        {"position_m": [9.0, 16.0, -2.0], "moment_Am2": [30.0, -20.0, -30.0]},
    ]
    return changed


def command(*arguments: str) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        status = status_of(list(arguments))
    if status:
        raise SystemExit(status)


def tensor_error(survey: Path, calibrated: Path) -> float:
    """Relative rms error where the tensor is no noise and the array is small against the distance of the source."""
    with h5py.File(survey) as file:
        true = file["truth/tensor_true"][:]
    with xr.open_dataset(calibrated, group="calibrated", engine="h5netcdf") as found:
        miss = found["tensor"].values - true
    size = np.sqrt(np.sum(true**2, axis=(1, 2)))
    at = (size > 50.0) & (size < 300.0)
    return float(np.sqrt(np.mean(miss[at] ** 2) / np.mean(true[at] ** 2)))


def chain(tilt_deg: tuple[float, float, float], height: float, seed: int) -> list[str]:
    """One row: angle left free, tensor error before, after refining, and with an attitude; the claimed deviation."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tumbling = scenario(seed, tilt_deg)
        write(simulate(tumbling), folder / "plain.h5")
        write(simulate(tumbling | {"logging": {"attitude": True, "attitude_noise_deg": 0.1}}), folder / "attitude.h5")
        survey = folder / "lines.h5"
        write(simulate(lines(tumbling, height)), survey)
        for kind in ("plain", "attitude"):
            command("run", str(RECIPE), "--input", str(folder / f"{kind}.h5"), "--output", str(folder / kind))
            command("apply", str(folder / kind / "calibration.nc"), str(survey), "--output", str(folder / f"{kind}.nc"))
        command("apply", str(folder / "plain" / "calibration.nc"), str(survey), "--output", str(folder / "refined.nc"),
                "--refine-rotation", "--save-calibration", str(folder / "again.nc"))  # fmt: skip
        tied, again = (
            open_result(folder / p)["calibration/common_rotation"] for p in ("attitude/calibration.nc", "again.nc")
        )
        apart = np.degrees(Rotation.from_matrix(again.values @ tied.values.T).magnitude())
        errors = [tensor_error(survey, folder / f"{kind}.nc") for kind in ("plain", "refined", "attitude")]
        return [
            f"{tied.attrs['turned_by_deg']:.2f}",
            f"{height:g}",
            *(f"{100 * e:.2f}" for e in errors),
            f"{apart:.3f}",
            f"{np.sqrt(np.sum(again.attrs['std_deg'] ** 2)):.3f}",
        ]


def table(heads: list[str], rows: list[list[str]]) -> str:
    lines_ = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in lines_)


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print("# The common rotation\n\nPrinted by `python studies/common_rotation.py`; simulated data throughout.\n")
    print("## From the symmetry of the tensor alone\n")
    print(
        f"Noise {TENSOR_NOISE:g} nT/m of one element, baseline {BASELINE} m, random tensors whose five components have "
        f"the standard deviation G, a start up to some 45 deg off; {RUNS['cross']} "
        f"runs of the cross, {RUNS['triangle']} of the others. `METHODS` is an independent "
        "study's figure for the planar cross.\n"
    )
    rows = []
    for shape in RUNS:
        for (size, samples), figure in PUBLISHED.items():
            left, claimed, standardised = recovered(shape, size, samples)
            known = f"{figure:g}" if shape == "cross" else ""
            rows.append([shape, str(size), str(samples), f"{left:.3g}", f"{claimed:.3g}", f"{standardised:.2f}", known])
    heads = ["array", "G, nT/m", "samples", "angle left, deg rms", "claimed, deg", "standardised squared", "METHODS"]
    print(table(heads, rows))
    print("\n## The tensor in a gradient, from file to file\n")
    print(
        "Ten minutes of tumbling in a uniform field, then eight lines past two dipoles of some 45 A m2; relative rms "
        "error of the tensor where it is between 50 and 300 nT/m. `apart` is the angle "
        "between the frame by symmetry and that by an attitude of 0.1 deg noise.\n"
    )
    rows = [
        chain(tilt, height, seed)
        for seed, (tilt, height) in enumerate(
            [((2.0, -1.0, 1.5), 2.0), ((7.0, -4.5, 6.0), 2.0), ((7.0, -4.5, 6.0), 3.0), ((16.0, -18.0, 14.0), 2.0)]
        )
    ]
    heads = ["turned by, deg", "height, m", "before, %", "refined on the lines, %", "by attitude, %", "apart, deg",
             "claimed, deg"]  # fmt: skip
    print(table(heads, rows))


if __name__ == "__main__":
    main()
