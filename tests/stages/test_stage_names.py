"""The stages put the sensors' names where a method counts them."""

import numpy as np
import pytest

from magtensor import DataError
from magtensor.survey.model import Survey
from magtensor_methods import chi2017, procrustes
from magtensor_stages import align, calibrate_scalar
from magtensor_stages.sensors import by_name

NAMES = ["bow", "port", "stern"]


@pytest.mark.parametrize(
    "text, wanted",
    [
        ("sensor 3", "sensor stern"),
        ("the handedness of sensors 2, 3: the field", "the handedness of sensors port, stern: the field"),
        ("sensors 1 and 2 share one position", "sensors bow and port share one position"),
        ("contrast_rms_2_nT", "contrast_rms_port_nT"),
        ("sensors 1 to 4 on +x, +y, -x, -y are right", "sensors 1 to 4 on +x, +y, -x, -y are right"),
        ("sensor 12 of 3 sensors, 2 nT", "sensor 12 of 3 sensors, 2 nT"),
    ],
)
def test_numbers_become_names(text: str, wanted: str) -> None:
    assert by_name(text, NAMES) == wanted


def named_survey(mirrored: int | None = None) -> Survey:
    rng = np.random.default_rng(1)
    u = rng.normal(size=(100, 3))
    b = 50_000.0 * u / np.linalg.norm(u, axis=1, keepdims=True)
    raw = b[:, None] + rng.normal(size=(100, 3, 3)) + np.array([[10.0], [20.0], [30.0]])
    if mirrored is not None:
        raw[:, mirrored, 0] *= -1
    return Survey.build(
        {
            "time": (("time",), np.arange(100.0), {"units": "seconds since 2026-01-01T00:00:00Z"}),
            "sensor": (("sensor",), np.array(NAMES), {}),
            "axis": (("axis",), np.array(["x", "y", "z"]), {}),
            "b_raw": (("time", "sensor", "axis"), raw, {"units": "nT"}),
            "total_field": (("time",), np.full(100, 50_000.0), {"units": "nT"}),
        }
    )


def aligned(survey: Survey, to: str) -> Survey:
    def method(*args, **options):
        return procrustes(*args, **options)

    calibrated = survey.merged(calibrate_scalar(survey, method=chi2017))
    return calibrated.merged(align(calibrated, method=method, to=to))


def test_alignment_names_its_sensors() -> None:
    matrix = aligned(named_survey(), "port")["calibration/matrix"]
    assert matrix.attrs["frame"] == "sensor port"
    assert "contrast_rms_stern_nT" in matrix.attrs["diagnostics"]
    assert "contrast_rms_3_nT" not in matrix.attrs["diagnostics"]


def test_a_mirrored_sensor_is_named() -> None:
    with pytest.raises(DataError, match="x axis of sensor stern is inverted against sensor bow"):
        aligned(named_survey(mirrored=2), "bow")
