"""Terms tested in noise of each sensor's own spectrum: the p value is one, whoever is noisy and by whatever law."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, linear_state, synthetic
from scipy.signal import lfilter

from magtensor.error_models.station import Station
from magtensor.error_models.terms import joined
from magtensor.loop.evidence.colour import colour_of
from magtensor.loop.evidence.folds import block_count
from magtensor.loop.evidence.grams import grams
from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.evidence.sensor_noise import smoothed_spectrum
from magtensor.loop.evidence.statistics import family_p
from magtensor.loop.fitting.model import Fitting, State
from magtensor.loop.searching.adopting import adopt
from magtensor.loop.searching.gates import ALPHA, Candidate
from magtensor.loop.searching.on_fewer_sensors import named
from magtensor.loop.searching.rounds import with_lines
from magtensor.loop.searching.screening import candidates_of
from magtensor.registry import Registry

SAMPLES = 1500


def wandering(rng: np.random.Generator, tau: float, lags: int = 1, samples: int = SAMPLES) -> Array:
    """A stationary series (N, 3) of unit rms through first-order lags of a time constant in samples."""
    course, keep = rng.standard_normal((samples + round(20 * tau), 3)), np.exp(-1.0 / tau)
    for _ in range(lags):
        course = lfilter([1.0 - keep], [1.0, -keep], course, axis=0)
    course = course[-samples:]
    out: Array = course / course.std()
    return out


def noisy(seed: int, noise: dict[int, float], tau: float, lags: int = 1, axis: int | slice = slice(None)) -> Array:
    """(N, 4, 3) slow noise of some sensors, or of one axis of each: rms in nT by the sensor's number."""
    rng = np.random.default_rng(seed)
    added = np.zeros((SAMPLES, 4, 3))
    for sensor, rms in noise.items():
        added[:, sensor, axis] = rms * wandering(rng, tau, lags)[:, axis]
    return added


NOISES = {
    "white": ({}, 10.0, 1),
    "one sensor": ({2: 1.0}, 60.0, 1),
    "one sensor, smooth": ({2: 1.0}, 30.0, 2),
    "two sensors": ({0: 0.3, 2: 1.0}, 200.0, 1),
    "all sensors": ({0: 1.0, 1: 1.0, 2: 1.0, 3: 1.0}, 60.0, 1),
    "one axis": ({2: 3.0}, 60.0, 1, 2),
    "one axis that walks": ({2: 5.0}, 3000.0, 1, 2),
}


@pytest.mark.long
@pytest.mark.parametrize("which", NOISES)
def test_the_p_value_is_one(which: str) -> None:
    """Offsets for a while at places that nobody sought: of 80 the p values are as even as chance has them."""
    offset_while = Registry.load().find("error_model", "offset_while")
    found = []
    for seed in range(4):
        added = noisy(100 + seed, *NOISES[which])  # type: ignore[arg-type]
        state = linear_state(synthetic(200 + seed, SAMPLES, turning_s=4.0, noise_nT=0.3, added=added))
        noise = OwnNoise(state.residual, None)
        for begin in range(60, 1260, 60):
            terms = offset_while.function(state.excitation, time_s=begin + 0.5, until_s=begin + 120.5)
            found.append(noise.p_value(terms.at(state.residual.samples)))
    p = np.array(found)
    assert 0.35 < p.mean() < 0.75
    assert np.mean(p < 0.1) < 0.2  # of neighbours that overlap some 40 are independent
    assert p.min() > 1e-4


def test_slow_noise_of_one_sensor_is_no_offset_for_a_while() -> None:
    """The scatter over blocks is no guard against it: what happens once lies in two or three of these."""
    offset_while = Registry.load().find("error_model", "offset_while")
    by_blocks = 0
    for seed in range(3):
        record = synthetic(seed, SAMPLES, turning_s=4.0, noise_nT=0.15, added=noisy(seed, {2: 0.4}, 200.0))
        state = with_lines(linear_state(record), record)
        (found,) = candidates_of(state, [offset_while], {}, ALPHA)
        by_blocks += scatter_over_blocks(state, found) * found.tried < ALPHA
        assert found.adjusted_p > ALPHA and not found.passes
    assert by_blocks


def scatter_over_blocks(state: State, found: Candidate) -> float:
    colours, count = found.assessment.colours, block_count(SAMPLES)
    blocks = grams(state.residual, found.terms, colours.across, colours.along, count)
    return family_p(blocks, found.terms.sensors, list(range(found.terms.count)))


def test_a_quiet_sensor_beside_it_is_judged_by_its_own_noise() -> None:
    """An offset of 0.15 nT for a fifth of the time stands out in the quiet sensor, not in the noisy one: with its
    spectrum known, chi-square of three coefficients would be 2 more than their number."""
    offset_while = Registry.load().find("error_model", "offset_while")
    p = {}
    for sensor in (0, 2):
        added = noisy(4, {2: 1.0}, 60.0)
        added[600:900, sensor] += [0.15, -0.15, 0.15]
        state = linear_state(synthetic(4, SAMPLES, turning_s=4.0, noise_nT=0.15, added=added))
        terms = offset_while.function(state.excitation, time_s=599.5, until_s=899.5).at(state.residual.samples)
        p[sensor] = OwnNoise(state.residual, None).p_value(terms.only(range(3 * sensor, 3 * sensor + 3)))
    assert p[0] < 1e-6 and p[2] > 1e-3


def test_what_is_in_already_is_free() -> None:
    """Beside itself nothing is left of a term, and beside another it is what it is beside that one."""
    step = Registry.load().find("error_model", "offset_step")
    added = np.zeros((SAMPLES, 4, 3))
    added[700:, 1] = 1.0
    state = linear_state(synthetic(6, SAMPLES, turning_s=4.0, noise_nT=0.3, added=added))
    terms, other = (step.function(state.excitation, time_s=at).at(state.residual.samples) for at in (699.5, 300.5))
    assert OwnNoise(state.residual, None).p_value(terms) < 1e-10
    assert OwnNoise(state.residual, terms).p_value(terms) == 1.0
    assert OwnNoise(state.residual, other).p_value(terms) < 1e-10
    assert OwnNoise(state.residual, terms).p_value(other) > 1e-3


def test_two_sensors_and_no_reference() -> None:
    """What one of two sensors does and a total field that is not known: the contrast alone."""
    added = np.zeros((SAMPLES, 2, 3))
    added[700:, 1] = 0.3
    record = synthetic(7, SAMPLES, sensors=2, turning_s=4.0, noise_nT=0.3, added=added)
    state = linear_state(record)
    step = Registry.load().find("error_model", "offset_step")
    there, elsewhere = (step.function(state.excitation, time_s=at).at(state.residual.samples) for at in (699.5, 200.5))
    for residual in (state.residual, replace(state.residual, along=None), replace(state.residual, across=None)):
        assert OwnNoise(residual, None).p_value(there) < 1e-4 < OwnNoise(residual, None).p_value(elsewhere)


def test_the_smoothed_spectrum_is_that_of_noise_which_no_law_describes() -> None:
    """White after it in every octave, where the fitted law is off by more than a factor of two."""
    rng = np.random.default_rng(1)
    series = np.column_stack([wandering(rng, 60.0, 2, 3000) for _ in range(14)])
    series += 0.02 * rng.standard_normal(series.shape)
    power = frequencies(series) ** 2
    edges = [1, 2, 4, *(8 * 2**k for k in range(9))]

    def octaves(ratio: Array) -> Array:
        return np.array([np.mean(ratio[a:b]) for a, b in itertools.pairwise(edges)])

    smoothed = octaves(power.mean(axis=1) / smoothed_spectrum(power.mean(axis=1)))
    np.testing.assert_allclose(smoothed[2:], 1.0, atol=0.2)
    assert np.all(smoothed[:2] < 1.6)  # of the first three frequencies only a line through them is known
    law = colour_of(series, stiff=True)
    assert law.power is not None
    by_law = octaves(power.mean(axis=1) / (law.white * law.power))
    assert max(by_law.max(), 1.0 / by_law.min()) > 2.0


def test_below_its_lowest_octave_a_steep_spectrum_goes_on_to_rise() -> None:
    """Of 1/f^2 the mean of the first three frequencies is a half of the first."""
    found = smoothed_spectrum(1.0 / np.maximum(np.arange(4000.0), 0.5) ** 2)
    np.testing.assert_allclose(found[1:8] * np.arange(1, 8) ** 2, 1.0, atol=0.35)


def frequencies(series: Array) -> Array:
    """By the definition of the cosine transform."""
    n = len(series)
    cosines = np.cos(np.pi * np.outer(np.arange(n), np.arange(n) + 0.5) / n) * np.sqrt(2.0 / n)
    out: Array = cosines @ series
    return out


def with_gap(seed: int, first: int, end: int, added: Array | None = None) -> State:
    """A survey that lacks the samples from one to before another."""
    record = synthetic(seed, SAMPLES, turning_s=4.0, noise_nT=0.15, added=added)
    here = np.flatnonzero((np.arange(SAMPLES) < first) | (np.arange(SAMPLES) >= end))
    assert record.total_field is not None and record.quiet_field is not None
    return linear_state(
        replace(
            record, time=record.time[here], raw=record.raw[here],
            total_field=record.total_field[here], quiet_field=record.quiet_field[here],
        )
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("slow", [{}, {0: 0.1, 1: 0.1, 2: 0.1, 3: 0.1}], ids=["white", "slow too"])
def test_a_jump_beside_a_gap_is_no_likelier_than_elsewhere(slow: dict[int, float]) -> None:
    """The last sample before a gap and the first after it have noise, which does not go on through the gap."""
    offset_step = Registry.load().find("error_model", "offset_step")
    p = []
    for seed in range(230, 235):
        state = with_gap(seed, 600, 900, noisy(seed, slow, 60.0))
        noise = OwnNoise(state.residual, None)
        for time_s in (200.0, 598.0, 901.0):
            p.append(noise.p_value(offset_step.function(state.excitation, time_s=time_s).at(state.residual.samples)))
    assert min(p) > 1e-3
    assert np.mean(np.array(p) < 0.01) < 0.1


@pytest.mark.long
def test_slow_noise_goes_on_in_a_gap() -> None:
    """Half an hour is missing while an axis walks on: no jump that its own spectrum could not make."""
    offset_step = Registry.load().find("error_model", "offset_step")
    p = []
    for seed in range(200, 206):
        state = with_gap(seed, 700, 1000, noisy(seed, {2: 3.0}, 3000.0, 1, 2))
        terms = offset_step.function(state.excitation, time_s=850.0).at(state.residual.samples)
        p.append([OwnNoise(r, None).p_value(terms) for r in (state.residual, replace(state.residual, time=None))])
    over_time, as_if_no_gap = np.array(p).T
    assert over_time.min() > 1e-3
    assert as_if_no_gap.min() < 1e-6


def read_rarely(seed: int, every: int, noise_nT: float) -> State:
    """A survey whose base station is read once in so many samples, with noise of its own."""
    record = synthetic(seed, SAMPLES, turning_s=4.0, noise_nT=0.1)
    assert record.total_field is not None
    rng, at = np.random.default_rng(seed), np.arange(0, SAMPLES + every, every)
    read = np.interp(record.time, at, np.interp(at, record.time, record.total_field) + rng.normal(0, noise_nT, len(at)))
    station = Station(at.astype(float), np.interp(at, record.time, read))
    return linear_state(replace(record, total_field=read, station=station))


@pytest.mark.long
def test_readings_that_are_far_apart_are_no_more_than_they_are() -> None:
    """The noise of a base station that is read every thirty samples has fifty values, not 1500: what is drawn from one
    to the next is no evidence of its own."""
    p = []
    for seed in range(300, 304):
        state = read_rarely(seed, 30, 0.3)
        station, rng = state.excitation.readings, np.random.default_rng(seed + 1000)
        both = [OwnNoise(r, None) for r in (state.residual, replace(state.residual, reading_s=0.0))]
        for _ in range(15):
            another = np.interp(state.excitation.time, station.time, rng.standard_normal(len(station.time)))
            terms = state.excitation.on_reference(another, "nT", "another").at(state.residual.samples)
            p.append([noise.p_value(terms) for noise in both])
    as_read, as_if_every_sample = np.array(p).T
    assert np.mean(as_read < 0.1) < 0.2
    assert as_read.min() > 1e-3
    assert as_if_every_sample.min() < 1e-4


def swinging(rng: np.random.Generator, swings: tuple[float, float]) -> Array:
    """A smooth series (N,) of unit rms, of sines with so many swings in a survey."""
    time = np.linspace(0.0, 1.0, SAMPLES)
    each = [np.sin(2.0 * np.pi * (rng.uniform(*swings) * time + rng.uniform())) for _ in range(4)]
    course = rng.standard_normal(4) @ each
    out: Array = (course - np.mean(course)) / np.std(course)
    return out


@pytest.mark.parametrize("seed", range(12))
def test_of_what_is_smooth_and_strong_few_values_are_independent(seed: int) -> None:
    """A field of the site that the base station does not see, 300 times the noise of |b| - F, and a course of the
    station's that has nothing to do with it: both have kinks where the survey ends, and both are seen through noise
    that turns with the platform. What pulsates in it is found."""
    rng = np.random.default_rng(400 + seed)
    record = synthetic(500 + seed, SAMPLES, turning_s=4.0, noise_nT=0.15)
    raw = record.raw + 0.1 * rng.standard_normal((SAMPLES, 4, 3)) * np.array([3.0, 1.0, 0.3])
    site, slow, fast = (swinging(rng, swings) for swings in ((0.3, 2.0), (0.3, 2.0), (30.0, 80.0)))
    assert record.total_field is not None
    field = record.total_field - 25.0 * site - 0.05 * fast
    state = linear_state(replace(record, raw=raw, total_field=field, quiet_field=field))
    noise = OwnNoise(state.residual, None)
    of_none, of_both = (
        noise.p_value(state.excitation.on_reference(course, "nT", "course").at(state.residual.samples))
        for course in (slow, fast)
    )
    assert of_none > 1e-6
    assert of_both < 1e-6


def test_what_the_fit_takes_of_a_reference_is_no_evidence() -> None:
    """A constant is a scale of all sensors but for the variation of the field, which holds the station's noise."""
    state = read_rarely(310, 30, 0.3)
    x = state.excitation
    constant = x.on_reference(np.full(len(x.time), 1.0), "nT", "level").at(state.residual.samples)
    assert OwnNoise(state.residual, None).p_value(constant) == 1.0


@pytest.mark.parametrize("seed", [6, pytest.param(8, marks=pytest.mark.long)])
def test_sensors_that_show_an_event_are_kept_with_it(seed: int) -> None:
    """0.1 nT for a fifth of the time: the scatter of long blocks shows it on one or two of the three."""
    offset_while = Registry.load().find("error_model", "offset_while")
    rng = np.random.default_rng(seed)
    added = 0.05 * np.stack([wandering(rng, 200.0) for _ in range(4)], axis=1)
    added[600:900] += 0.75 * np.array([[0.2, 0.13, -0.03], [0.0, 0.0, 0.0], [0.2, -0.05, 0.05], [-0.1, 0.15, 0.08]])
    record = synthetic(700 + seed, SAMPLES, turning_s=4.0, noise_nT=0.15, added=added)
    state = with_lines(linear_state(record), record)
    (found,) = candidates_of(state, [offset_while], {}, ALPHA)
    assert found.passes
    after = adopt(record, state, found, Fitting())
    assert named(after, 0) == ("S1", "S3", "S4")  # and of the fourth what it may have, for most of them show it
    assert after.adopted[0].sensors == ()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("samples", "sensors", "given"), [(136, 3, 16), (300, 9, 30)])
def test_beside_series_that_take_all_of_the_lowest_octaves(samples: int, sensors: int, given: int) -> None:
    """Nothing is left to tell the noise there by, and nothing of what is slow."""
    state = linear_state(synthetic(1, samples, sensors=sensors, noise_nT=0.3))
    x, all_of_them = state.excitation, state.residual.samples
    drift = Registry.load().find("error_model", "warm_up").function(x, tau_s=samples / 5.0)
    time = np.linspace(0.0, 1.0, len(x.time))
    taken = [replace(drift, series=np.cos(np.pi * k * time)[:, None]) for k in range(1, given + 1)]
    p = OwnNoise(state.residual, joined(taken).at(all_of_them)).p_value(drift.at(all_of_them))
    assert 0.01 < p <= 1.0


@pytest.mark.parametrize("step_nT", [0.0, 0.3])
def test_a_sensor_that_jumps_when_the_base_station_does(step_nT: float) -> None:
    """The step that is free in the reference takes nothing of what differs between the sensors."""
    added = np.zeros((SAMPLES, 4, 3))
    added[SAMPLES // 2 :, 0] = step_nT * np.array([0.0, 0.74, -0.67])
    state = linear_state(synthetic(31, SAMPLES, turning_s=4.0, noise_nT=0.2, added=added))
    x, every = state.excitation, state.residual.samples
    of_sensors, of_reference = (
        Registry.load().find("error_model", name).function(x, time_s=SAMPLES // 2 * x.spacing)
        for name in ("offset_step", "reference_step")
    )
    p = OwnNoise(state.residual, of_reference.at(every)).p_value(of_sensors.at(every))
    assert p < 1e-9 if step_nT else 0.01 < p <= 1.0
