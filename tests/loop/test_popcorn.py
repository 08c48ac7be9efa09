"""A sensor that stays at a level for a while and jumps to another one: no lone event, and no steady noise."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from loop_cases import Array, adopted_names, flicker, linear_state, scenario, synthetic, verdict_of

from magtensor.loop.evidence.jumps import jumpiness
from magtensor.loop.fitting.model import Fitting
from magtensor.loop.remainder.popcorn import JUMPS, popcorn_words
from magtensor.loop.searching import search
from magtensor.registry import Registry


def levels(rng: np.random.Generator, samples: int, stays: float) -> Array:
    """(N,) a new level of unit variance after so many samples on average."""
    edges = np.cumsum(rng.exponential(stays, size=samples))
    return np.asarray(rng.standard_normal(samples + 1)[np.searchsorted(edges, np.arange(samples))])


def steady(rng: np.random.Generator, samples: int, kind: str) -> Array:
    if kind == "1/f":
        return flicker(rng, (samples,), crossing=0.1)
    if kind == "loud for a while":
        times = np.where(np.arange(samples) // 300 % 3 == 1, 5.0, 1.0)
        return np.asarray(times * rng.standard_normal(samples))
    walk, keep = np.zeros(samples), np.exp(-1.0 / 40.0)
    for k in range(1, samples):
        walk[k] = keep * walk[k - 1] + rng.standard_normal() * np.sqrt(1.0 - keep**2)
    return 2.0 * walk + rng.standard_normal(samples)


@pytest.mark.parametrize("kind", ["1/f", "loud for a while", "one time constant"])
@pytest.mark.parametrize("samples", [600, 2400])
def test_steady_noise_goes_in_no_jumps(kind: str, samples: int) -> None:
    rng = np.random.default_rng(samples)
    found = np.array([jumpiness(steady(rng, samples, kind)) for _ in range(200)])
    assert found.max() < JUMPS
    assert np.mean(found > 2.5) < 0.03  # as of what an event is suspected for: one in a hundred


@pytest.mark.parametrize("pauses", [3, 12, 40])
def test_steady_noise_goes_in_no_jumps_across_pauses(pauses: int) -> None:
    """It goes on while nothing is recorded: what differs before and after by more than usual is no jump."""
    rng = np.random.default_rng(pauses)
    within = np.arange(2400) % (2400 // pauses + 1) > 3 * (2400 // pauses) // 4
    run = np.cumsum(np.diff(within, prepend=False) & ~within)[~within]
    series = [steady(rng, 2400, "one time constant")[~within] for _ in range(100)]
    assert max(jumpiness(one, run) for one in series) < JUMPS


def test_levels_go_in_jumps_between_pauses_too() -> None:
    rng = np.random.default_rng(2)
    run = np.repeat(np.arange(6), 200)
    found = [jumpiness(levels(rng, 1200, 60.0) * 3.0 + rng.standard_normal(1200), run) for _ in range(50)]
    assert np.median(found) > JUMPS
    assert jumpiness(levels(rng, 1200, 60.0), np.repeat(np.arange(200), 6)) == 0.0  # nowhere long enough to ask


def test_levels_do() -> None:
    rng = np.random.default_rng(2)
    found = [jumpiness(levels(rng, 1200, 60.0) * 3.0 + rng.standard_normal(1200)) for _ in range(50)]
    assert np.median(found) > 2.0 * JUMPS


@pytest.mark.parametrize(("seed", "size"), [(3, 2.0), (5, 2.0), (6, 2.0), (3, 1.2)])
def test_one_of_many_jumps_is_no_event(seed: int, size: float) -> None:
    added = np.zeros((1200, 4, 3))
    added[:, 0, 1] = size * levels(np.random.default_rng(800 + seed), 1200, 60.0 if size == 2.0 else 30.0)
    record = synthetic(seed, added=added, turning_s=4.0)
    found = search.search(record, [Registry.load().find("error_model", "offset_while")], Fitting())
    assert found.last.adopted == ()


@pytest.mark.long
def test_how_often_one_of_many_jumps_is_taken_for_an_event() -> None:
    """Surveys that no threshold was chosen by: half of them had an event without the suspicion."""
    model, taken = Registry.load().find("error_model", "offset_while"), 0
    for seed in range(20, 40):
        added = np.zeros((1200, 4, 3))
        added[:, 0, 1] = 2.0 * levels(np.random.default_rng(3000 + seed), 1200, 60.0)
        record = synthetic(seed, added=added, turning_s=4.0)
        taken += len(search.search(record, [model], Fitting()).last.adopted) > 0
    assert taken <= 5


@pytest.mark.parametrize("seed", [0, 1, 2, 4])
def test_an_event_in_steady_noise_stays_one(seed: int) -> None:
    """Slow noise of a sensor as strong as its white noise, and an offset for a while that no such noise has."""
    rng = np.random.default_rng(40 + seed)
    added = np.zeros((1200, 4, 3))
    added[:, 0] = np.column_stack([flicker(rng, (1200,), crossing=0.03) for _ in range(3)])
    added[500:700, 0, 1] += 3.0
    record = synthetic(seed, added=added, turning_s=4.0)
    found = search.search(record, [Registry.load().find("error_model", "offset_while")], Fitting())
    assert [a.name for a in found.last.adopted] == ["offset_while"]


@pytest.mark.parametrize(("sensors", "where"), [(2, "S1 or S2"), (4, "S1")])
def test_the_sensor_its_axis_and_the_size_are_told(sensors: int, where: str) -> None:
    added = np.zeros((2400, sensors, 3))
    added[:, 0, 1] = 4.0 * levels(np.random.default_rng(7), 2400, 40.0)
    (words,) = popcorn_words(linear_state(synthetic(1, 2400, sensors, added=added, turning_s=4.0)))
    found = re.fullmatch(r"what is left of (.*) goes in jumps, .*: ([\d.]+) nT rms along \((.*), (.*), (.*)\)", words)
    assert found is not None and found[1] == where
    assert float(found[2]) == pytest.approx(added[:, 0, 1].std(), rel=0.1)
    assert abs(float(found[4])) > 0.99


def test_the_verdict_says_so(tmp_path: Path) -> None:
    def change(path: Path) -> None:
        with h5py.File(path, "r+") as survey:
            raw = survey["b_raw"][:]
            raw[:, 2, 0] += 0.6 * levels(np.random.default_rng(9), len(raw), 40.0)
            survey["b_raw"][...] = raw

    verdict = verdict_of(tmp_path, scenario(101), change, ["offset_while", "offset_step"])
    assert adopted_names(verdict) == set()
    assert verdict["unexplained"]["present"]
    assert "what is left of S3 goes in jumps" in verdict["unexplained"]["description"]
