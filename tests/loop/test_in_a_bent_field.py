"""A hidden source on a survey whose field bends within the array: not taken off where it may be that field."""

from __future__ import annotations

import numpy as np
import pytest
from loop_cases import Array

from magtensor.error_models.waveform import bends, course_of, too_little_shows
from magtensor.tensor.geometry import array_design

CROSS = 0.25 * np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]])
NOISE_NT, SAMPLES = 0.1, 2000
VECTOR = np.array([0.9, -0.4, 0.3, 0.1, 0.8, -0.2, -0.5, 0.3, 0.6, 0.2, -0.7, 0.4])  # nT per unit at the outputs


def dipole(at: Array, moment: Array, point: Array) -> Array:
    """nT of a dipole (A m2) at points (..., 3) m, by the textbook's formula."""
    r = point - at
    size = np.linalg.norm(r, axis=-1, keepdims=True)
    out: Array = 100.0 * (3.0 * r * (r @ moment)[..., None] / size**5 - moment / size**3)
    return out


def passing(distance_m: float, moment: float) -> Array:
    """(N, 12) nT at the sensors of an array that is carried along a line past a dipole."""
    along = np.linspace(-10.0, 10.0, SAMPLES)
    points = CROSS + np.stack([along, np.full(SAMPLES, distance_m), np.full(SAMPLES, 1.0)], axis=1)[:, None]
    return dipole(np.zeros(3), moment * np.array([0.3, 0.2, 1.0]), points).reshape(SAMPLES, -1)


def outputs(field: Array, source: float, seed: int = 1) -> tuple[Array, Array]:
    """Whitened outputs, and the waveform in them, in units of the vector."""
    rng = np.random.default_rng(seed)
    waveform = source * np.sin(np.arange(SAMPLES) / 40.0)
    noise = NOISE_NT * rng.standard_normal((SAMPLES, 12))
    return (field + np.outer(waveform, VECTOR) + noise) / NOISE_NT, waveform


@pytest.mark.parametrize(
    ("distance_m", "moment", "source", "bent"),
    [
        (1e3, 0.0, 1.0, False),  # a uniform field
        (1e3, 0.0, 0.0, False),
        (30.0, 300.0, 1.0, False),  # a gradient that does not bend within the array
        (2.0, 30.0, 1.0, True),
        (2.0, 30.0, 0.0, True),
        (2.0, 3.0, 20.0, False),  # a source that stands far above what bends
    ],
)
def test_which_is_larger(distance_m: float, moment: float, source: float, bent: bool) -> None:
    whitened, _ = outputs(passing(distance_m, moment), source)
    held = array_design(CROSS, "gradient").reshape(12, -1) / NOISE_NT
    assert bends(whitened, held, VECTOR / NOISE_NT) is bent


def test_it_would_be_taken_for_the_source() -> None:
    """What the refusal is for: whatever the vectors, where the waveform's error is twice the source it is refused."""
    held = array_design(CROSS, "gradient").reshape(12, -1) / NOISE_NT
    field, rng = passing(2.0, 300.0) / NOISE_NT, np.random.default_rng(4)
    wrong = 0
    for _ in range(40):
        vector = rng.standard_normal(12)
        noise = rng.standard_normal((SAMPLES, 12))
        waveform = np.sin(np.arange(SAMPLES) / 40.0)
        whitened = field + np.outer(waveform, vector / NOISE_NT) + noise
        found = course_of(whitened, held, vector / NOISE_NT).values
        if np.std(found - waveform) > 2.0 * np.std(waveform):
            wrong += 1
            assert bends(whitened, held, vector / NOISE_NT)
    assert wrong > 5


def test_three_sensors_have_one_free_direction_and_cannot_tell() -> None:
    held = array_design(CROSS[:3], "gradient").reshape(9, -1) / NOISE_NT
    whitened, _ = outputs(passing(2.0, 30.0), 1.0)
    assert not bends(whitened[:, :9], held, VECTOR[:9] / NOISE_NT)


@pytest.mark.parametrize(("beside", "little"), [(0.1, True), (0.2, False)])
def test_what_is_nearly_a_gradient_shows_too_little(beside: float, little: bool) -> None:
    """A tenth of the vector, in size, is a hundredth of its square."""
    held = array_design(CROSS, "gradient").reshape(12, -1)
    gradient = held @ np.random.default_rng(2).standard_normal(held.shape[1])
    off = VECTOR - held @ np.linalg.lstsq(held, VECTOR, rcond=None)[0]
    vector = gradient / np.linalg.norm(gradient) + beside * off / np.linalg.norm(off)
    assert too_little_shows(held, vector) is little
    waveform = np.sin(np.arange(SAMPLES) / 40.0)
    noise = 1e-3 * np.random.default_rng(3).standard_normal((SAMPLES, 12))
    assert (course_of(np.outer(waveform, vector) + noise, held, vector).rms == 0.0) is little
