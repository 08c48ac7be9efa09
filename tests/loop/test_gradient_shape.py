"""Whether what differs between the sensors has the shape of a uniform gradient."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from loop_cases import linear_state, loaded, scenario, synthetic, verdict_of
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtensor.loop.remainder.gradient_shape import gradient_share, only_of_a_gradient

Array = NDArray[np.float64]
TILTED = {"type": "limited_tilt", "duration_s": 1200.0, "tilt_deg": 40.0}
TRIANGLE = np.array([[0.3, 0, 0], [-0.15, 0.26, 0], [-0.15, -0.26, 0]])  # gradients leave one direction of six
CROSS = np.array([[0.3, 0, 0], [-0.3, 0, 0], [0, 0.3, 0], [0, -0.3, 0]])


def drawn(rng: np.random.Generator, position: Array, samples: int = 1200) -> Array:
    """(N, S, 3) nT: a gradient tensor drawn anew for every sample, times the positions."""
    g = rng.standard_normal((samples, 3, 3))
    g = g + np.swapaxes(g, 1, 2)
    g -= np.trace(g, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    out: Array = 10.0 * np.einsum("nij,sj->nsi", g, position)
    return out


def share_of(added: Array, position: Array | None) -> float:
    record = replace(synthetic(3, sensors=added.shape[1], added=added), position=position)
    return gradient_share(linear_state(record), record.position)


def test_a_gradient_is_seen_whatever_it_does_in_time() -> None:
    rng = np.random.default_rng(4)
    assert share_of(drawn(rng, CROSS), CROSS) > 0.97
    line = np.linspace(-0.5, 0.5, 4)[:, None] * np.array([1.0, 0.0, 0.0])
    assert share_of(drawn(rng, line), line) > 0.97
    assert share_of(drawn(rng, CROSS), CROSS[[2, 0, 3, 1]]) == 0.0  # of an array that stands otherwise


def test_errors_of_the_sensors_and_a_single_waveform_have_no_such_shape() -> None:
    rng = np.random.default_rng(5)
    assert share_of(3.0 * rng.standard_normal((1200, 4, 3)), CROSS) == 0.0
    one = 5.0 * np.sin(np.arange(1200) / 7.0)[:, None, None] * (np.diag([1.0, 1.0, -2.0]) @ CROSS.T).T
    assert share_of(one, CROSS) == 0.0  # whoever makes it
    noisy = np.zeros((1200, 3, 3))
    noisy[:, 1] = 0.3 * np.cumsum(np.random.default_rng(7).standard_normal((1200, 3)), axis=0)
    assert share_of(noisy, TRIANGLE) == 0.0


@pytest.mark.parametrize("waveforms", [2, 3])
def test_of_three_sensors_errors_seldom_look_like_it(waveforms: int) -> None:
    """With as many courses of time, in any proportion, of which one direction of six holds little by chance."""
    found = 0
    for seed in range(100):
        rng = np.random.default_rng(1000 + seed)
        phase = 2.0 * np.pi * rng.random(waveforms)
        courses = 5.0 * np.sin(np.arange(600)[:, None] / [40.0, 55.0, 70.0][:waveforms] + phase)
        record = synthetic(
            2000 + seed, 600, sensors=3, added=np.tensordot(courses, rng.standard_normal((waveforms, 3, 3)), 1)
        )
        found += gradient_share(linear_state(replace(record, position=TRIANGLE)), TRIANGLE) > 0.0
    assert found <= 5  # of 1 expected, with a probability of 0.9995


def test_of_three_sensors_a_gradient_is_still_seen() -> None:
    for seed in range(5):
        assert share_of(drawn(np.random.default_rng(seed), TRIANGLE), TRIANGLE) > 0.9


def test_nothing_has_that_shape_where_a_sensor_has_less_noise_than_its_quickest_errors() -> None:
    """Its noise, known from what is quickest, is taken for more than it is: the others' shape is left."""
    walk = 5.0 * np.sin(2.0 * np.pi * 0.46 * np.arange(1200))[:, None] * np.array([[1.0, 0.5, -0.3]])
    assert share_of(np.where(np.arange(4)[:, None] == 2, walk[:, None], 0.0), CROSS) == 0.0


@pytest.mark.parametrize("position", [None, CROSS[:2]])
def test_arrays_that_cannot_tell(position: Array | None) -> None:
    rng = np.random.default_rng(6)
    assert share_of(drawn(rng, CROSS[:2]), position) == 0.0


@pytest.mark.parametrize(
    ("effect", "shaped"),
    [
        ({"type": "site_gradient", "rms_nT": 0.5}, True),
        ({"type": "temperature_scale", "rms_nT": 0.5}, False),
        ({"type": "eddy_current", "rms_nT": 0.5}, False),
        ({"type": "nonlinearity_quadratic", "rms_nT": 0.5}, False),
    ],
)
def test_effects_of_a_simulated_survey(effect: dict[str, Any], shaped: bool, tmp_path: Path) -> None:
    record = loaded(tmp_path, scenario(5, effect))
    assert (gradient_share(linear_state(record), record.position) > 0.9) is shaped


def with_a_compass(path: Path) -> None:
    """A heading in the place of the attitude."""
    with h5py.File(path, "r+") as file:
        ahead = Rotation.from_quat(file["attitude"][()]).apply([1.0, 0.0, 0.0])
        del file["attitude"]
        file["heading"] = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1])) % 360.0
        file["heading"].attrs["units"] = "degree"


@pytest.mark.long
@pytest.mark.parametrize("effect", ["site_gradient", "temperature_scale"])
def test_a_compass_does_not_stand_for_the_attitude(tmp_path: Path, effect: str) -> None:
    """Of what a gradient of the site does a heading predicts a part."""
    models = ["site_gradient", "channel_response", "moving_part", "temperature_scale"]
    made = scenario(5, {"type": effect, "rms_nT": 0.6}, logging={"attitude": True}, motion=TILTED)
    told = verdict_of(tmp_path, made, with_a_compass, models)
    if effect == "site_gradient":
        refused = {name: why for step in told["steps"] for name, why in step["refused"].items()}
        assert "lacks the attitude" in refused["channel_response"]
        assert not told["adopted"] and told["unexplained"]["looks_like"][0] == "site_gradient"
    else:
        assert [a["error_model"] for a in told["adopted"]] == [effect]


def test_an_error_of_sensors_is_more_than_a_gradient_of_which_more_is_left() -> None:
    rng = np.random.default_rng(8)
    gradient = drawn(rng, CROSS)
    record = replace(synthetic(3, added=gradient), position=CROSS)
    some, own = 0.1 * gradient, np.zeros_like(gradient)
    own[:, 1] = 2.0 * np.sin(np.arange(1200) / 80.0)[:, None]
    for part, only in ((some, True), (own, False)):
        with_it = linear_state(replace(record, raw=record.raw + part))
        assert only_of_a_gradient(with_it, CROSS, linear_state(record).residual, 6) is only
    alone = linear_state(replace(synthetic(3, added=some + own), position=CROSS))
    assert not only_of_a_gradient(alone, CROSS, linear_state(synthetic(3)).residual, 6)
