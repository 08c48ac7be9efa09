"""Surveys of a length that has a large prime factor: searched without their last samples, corrected at all."""

from __future__ import annotations

import numpy as np
from loop_cases import linear_state, synthetic

from magtensor.loop.evidence.even_rate import EvenRate
from magtensor.loop.fitting.model import Fitting
from magtensor.loop.searching.latent import sought, tried_source
from magtensor.loop.searching.profiling import thinned
from magtensor.registry import Registry

PRIME = 5987  # samples


def test_a_source_is_known_at_the_samples_that_the_search_leaves_out() -> None:
    rng = np.random.default_rng(6)
    waveform = np.convolve(rng.standard_normal(PRIME + 19), np.ones(20), mode="valid") / np.sqrt(20.0)
    record = synthetic(5, samples=PRIME, added=waveform[:, None, None] * 3.0 * rng.standard_normal((4, 3)))
    state = linear_state(record)
    believed = np.flatnonzero(state.fit.keep)
    length = len(state.residual.samples)
    assert 0 < len(believed) - length < 0.013 * PRIME
    assert max(_factors(length)) <= 23
    np.testing.assert_array_equal(state.residual.samples, believed[:length])
    assert state.residual.across is not None and len(state.residual.across) == length
    np.testing.assert_array_equal(state.unabridged.residual.samples, believed)
    shared = sought(state, record)
    assert shared is not None and len(shared.values) == len(believed)
    hidden = Registry.load().find("error_model", "latent_source")
    source = tried_source(hidden, record, state, shared, Fitting(), 0.005)[1]
    assert source is not None and source.record.waveform is not None
    found = source.record.waveform
    last = slice(int(believed[length]), None)
    assert abs(np.corrcoef(found[last], waveform[last])[0, 1]) > 0.9
    entire = source.after.unabridged
    assert entire.terms is not None and len(entire.terms.series) == source.after.fit.keep.sum()


def test_the_part_that_is_screened_is_none_of_an_awkward_length() -> None:
    """Of 5980 samples every third makes 1994, twice a prime."""
    few, _ = thinned(linear_state(synthetic(8, samples=5980)), 2000)
    samples = few.samples
    assert 0.98 * 1994 < len(samples) < 1994
    assert max(_factors(len(samples))) <= 23
    assert len(set(np.diff(samples))) == 1


def test_nor_is_a_series_with_its_gaps_filled() -> None:
    time = np.delete(np.arange(PRIME + 1.0), 100)  # of 5988 places, 12 times a prime
    even = EvenRate.of(time)
    assert even is not None
    filled = even(time)
    assert 0.98 * PRIME < len(filled) < PRIME
    assert max(_factors(len(filled))) <= 23
    np.testing.assert_allclose(filled, np.arange(len(filled)))


def _factors(number: int) -> list[int]:
    for factor in range(2, number):
        if number % factor == 0:
            return [factor, *_factors(number // factor)]
    return [number]


def test_short_ones_are_searched_whole() -> None:
    state = linear_state(synthetic(7, samples=997))
    np.testing.assert_array_equal(state.residual.samples, np.flatnonzero(state.fit.keep))
    assert state.unabridged is state
