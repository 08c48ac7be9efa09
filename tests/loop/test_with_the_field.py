"""A gain that flickers, stamps that wander: what they leave lies along the field or its rate, which no noise does."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import linear_state, loaded, scenario, verdict_of

from magtensor.loop.remainder.with_the_field import with_the_field

SENSORS = ["S1", "S2", "S3", "S4"]


def _walk(rng: np.random.Generator, count: int, steps: float) -> np.ndarray:
    """(count,) an Ornstein-Uhlenbeck process of unit variance that forgets in so many samples."""
    out, keep = np.empty(count), np.exp(-1.0 / steps)
    out[0] = rng.standard_normal()
    for k, pushed in enumerate(rng.standard_normal(count - 1) * np.sqrt(1.0 - keep**2), start=1):
        out[k] = keep * out[k - 1] + pushed
    return out


def flickering(amount: float, sensors: tuple[int, ...] = (1,), axes: int = 1) -> Callable[[Path], None]:
    """The gain of sensors changes by that rms for about 10 s, that of every axis by itself if there are three."""

    def change(path: Path) -> None:
        rng = np.random.default_rng(3)
        with h5py.File(path, "r+") as survey:
            raw = survey["b_raw"][:]
            for sensor in sensors:
                gain = np.column_stack([_walk(rng, len(raw), 20.0) for _ in range(axes)])
                raw[:, sensor] *= 1.0 + amount * gain
            survey["b_raw"][...] = raw

    return change


def stamped_in_blocks(path: Path) -> None:
    """S2 is stamped as if its samples came in blocks of 32, each a little too fast: a saw-tooth of 3 ms."""
    with h5py.File(path, "r+") as survey:
        raw, time = survey["b_raw"][:], survey["time"][:]
        late = ((np.arange(len(time)) % 32) / 31.0 - 0.5) * 0.006
        raw[:, 1] += late[:, None] * np.gradient(raw[:, 1], time, axis=0)
        survey["b_raw"][...] = raw


def wandering(path: Path) -> None:
    """S2 has slow noise, S3 a loud stretch and S4 heavy tails."""
    rng = np.random.default_rng(4)
    with h5py.File(path, "r+") as survey:
        raw = survey["b_raw"][:]
        raw[:, 1] += np.column_stack([_walk(rng, len(raw), 40.0) for _ in range(3)])
        raw[400:900, 2] += rng.standard_normal((500, 3))
        raw[:, 3] += 0.2 * rng.standard_t(3, raw[:, 3].shape)
        survey["b_raw"][...] = raw


@pytest.mark.parametrize("amount", [1e-5, 1e-4])
def test_a_gain_is_told_with_its_size(amount: float, tmp_path: Path) -> None:
    (words,) = with_the_field(linear_state(loaded(tmp_path, scenario(101), flickering(amount))), stamps=True)
    found = re.fullmatch(
        r"what is left of (\S+) goes with what it reads, .* by ([\d.]+) ppm rms.*: ([\d.]+) nT rms", words
    )
    assert found is not None and found[1] == "S2"
    # known from some hundred seconds of independent values, and the fit has its own scale
    assert float(found[2]) == pytest.approx(1e6 * amount, rel=0.3)
    assert float(found[3]) == pytest.approx(49_500.0 * amount, rel=0.3)


def test_gains_of_single_axes_are_told(tmp_path: Path) -> None:
    (words,) = with_the_field(linear_state(loaded(tmp_path, scenario(101), flickering(3e-5, axes=3))), stamps=True)
    assert words.startswith("what is left of S2 goes with what each axis reads")


def swinging(axes: int) -> Callable[[Path], None]:
    """S3 swings, by 10 urad within some seconds, about one axis or about three."""

    def change(path: Path) -> None:
        rng = np.random.default_rng(7)
        with h5py.File(path, "r+") as survey:
            raw = survey["b_raw"][:]
            angle = 1e-5 * np.column_stack([_walk(rng, len(raw), 6.0) for _ in range(axes)])
            about = np.array([[0.6, -0.64, 0.48]]) if axes == 1 else np.eye(3)
            raw[:, 2] += np.cross(angle @ about, raw[:, 2])
            survey["b_raw"][...] = raw

    return change


@pytest.mark.parametrize("axes", [1, 3])
def test_a_mount_that_swings_is_told_with_its_size(axes: int, tmp_path: Path) -> None:
    """Its turn is all across the field, and noise is along it too."""
    state = linear_state(loaded(tmp_path, scenario(101), swinging(axes)))
    (words,) = with_the_field(state, stamps=True)
    found = re.fullmatch(r"what is left of S3 goes with what it reads, across that, .* by ([\d.]+) mrad rms.*", words)
    assert found is not None
    assert float(found[1]) == pytest.approx(1e-2 * np.sqrt(axes), rel=0.3)
    assert with_the_field(state, stamps=False) == []


def test_of_all_sensors_none_is_singled_out(tmp_path: Path) -> None:
    change = flickering(3e-5, (0, 1, 2, 3))
    (words,) = with_the_field(linear_state(loaded(tmp_path, scenario(101), change)), stamps=True)
    assert words.startswith("what is left of all sensors goes with") and words.endswith("of each")


def test_stamps_are_told_with_their_size(tmp_path: Path) -> None:
    state = linear_state(loaded(tmp_path, scenario(101), stamped_in_blocks))
    (words,) = with_the_field(state, stamps=True)
    found = re.fullmatch(r"what is left of S2 goes with how fast .* off by ([\d.]+) ms rms.*", words)
    assert found is not None
    assert float(found[1]) == pytest.approx(6.0 / np.sqrt(12.0), rel=0.3)
    assert with_the_field(state, stamps=False) == []


@pytest.mark.parametrize("seed", [101, 102, 103])
def test_noise_of_any_kind_is_not_taken_for_it(seed: int, tmp_path: Path) -> None:
    assert with_the_field(linear_state(loaded(tmp_path, scenario(seed))), stamps=True) == []
    assert with_the_field(linear_state(loaded(tmp_path, scenario(seed), wandering)), stamps=True) == []


@pytest.mark.parametrize("what", ["flickering", "stamped"])
def test_the_verdict_says_that_it_is_no_noise(what: str, tmp_path: Path) -> None:
    change = flickering(3e-5) if what == "flickering" else stamped_in_blocks
    verdict = verdict_of(tmp_path, scenario(101), change, [])
    assert verdict["adopted"] == []
    assert verdict["unexplained"]["present"]
    told = verdict["unexplained"]["description"]
    assert "what is left of S2 goes with" in told or "the noise of S2 grows with how fast the field turns" in told
