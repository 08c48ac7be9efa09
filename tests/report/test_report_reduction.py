"""What makes series short: nothing that the eye must see may be lost."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magtensor.report.reduction import cell_means, disc, envelope, spectrum, stretches, thinned, trend


@given(st.integers(1, 5000), st.integers(0, 2**31), st.integers(2, 50))
def test_envelope_keeps_every_extreme_and_the_total(samples: int, seed: int, columns: int) -> None:
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.exponential(1.0, samples) + 1e-3)
    values = rng.standard_normal(samples)
    values[rng.integers(samples)] = 1e3  # one spike
    values[rng.random(samples) < 0.1] = np.nan
    found = envelope(time, values, columns)
    known = values[np.isfinite(values)]
    assert found.samples == known.size
    if known.size:
        assert np.nanmax(found.high) == known.max() and np.nanmin(found.low) == known.min()
        drawn = np.isfinite(found.mean)
        assert drawn.sum() <= max(columns, min(known.size, 2 * columns))
        assert np.all(np.diff(found.time) >= 0)
        assert np.all(found.low[drawn] <= found.mean[drawn] + 1e-9) and np.all(
            found.mean[drawn] <= found.high[drawn] + 1e-9
        )


def test_envelope_breaks_the_line_at_a_gap() -> None:
    time = np.r_[np.arange(100.0), np.arange(500.0, 600.0)]
    found = envelope(time, np.ones(200))
    assert np.isnan(found.mean).sum() == 1 and found.time[100] == 99.0


def test_envelope_of_nothing() -> None:
    assert envelope(np.arange(3.0), np.full(3, np.nan)).samples == 0


def test_stretches_end_at_gaps_and_at_samples_not_in_use() -> None:
    time = np.r_[np.arange(10.0), np.arange(20.0, 30.0)]
    known = np.ones(20, dtype=bool)
    known[3] = False
    assert stretches(time, known) == [slice(0, 3), slice(4, 10), slice(10, 20)]
    assert stretches(time, np.zeros(20, dtype=bool)) == []


def test_spectrum_of_white_noise_is_flat_at_its_level_despite_gaps() -> None:
    # one-sided power of white noise: 2 sigma^2 / rate
    rng = np.random.default_rng(3)
    time = np.arange(60_000) * 0.1
    values = 0.2 * rng.standard_normal(60_000)
    values[rng.choice(60_000, 20, replace=False)] = np.nan
    found = spectrum(time, values)
    assert found is not None
    level = np.sqrt(np.mean(found.density[2:] ** 2))
    assert level == pytest.approx(0.2 * np.sqrt(2 * 0.1), rel=0.03)
    bins = thinned(found)
    assert len(bins.frequency) < len(found.frequency)
    assert np.all(np.diff(bins.frequency) > 0)


def test_spectrum_finds_a_line_where_it_is() -> None:
    time = np.arange(20_000) * 0.1
    found = spectrum(time, np.sin(2 * np.pi * 0.7 * time))
    assert found is not None
    assert found.frequency[np.argmax(found.density)] == pytest.approx(0.7, abs=2 * found.frequency[0])


def test_no_spectrum_where_no_stretch_is_long_enough() -> None:
    values = np.ones(150)
    values[::10] = np.nan
    assert spectrum(np.arange(150.0), values) is None


def test_disc_keeps_areas() -> None:
    rng = np.random.default_rng(5)
    direction = rng.standard_normal((200_000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = np.hypot(*disc(direction).T)
    # uniform on the sphere: uniform on the disc, so r^2 is uniform
    assert np.histogram(radius**2, 10, (0, 1))[0] / 20_000 == pytest.approx(np.ones(10), abs=0.03)
    assert disc(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])) == pytest.approx(
        np.array([[0.0, 0.0], [1.0, 0.0], [0.0, -1.0]])
    )


def test_cell_means_put_y_first_and_ignore_nan() -> None:
    grid = cell_means(np.array([[0.9, -0.9], [0.9, -0.9], [-0.9, 0.9]]), np.array([1.0, 3.0, np.nan]), cells=4)
    assert grid[0, 3] == 2.0
    assert np.isnan(grid[3, 0]) and np.isfinite(grid).sum() == 1


def test_trend_is_the_mean_of_each_slice_with_its_standard_error() -> None:
    values = np.r_[np.arange(6.0), 9.0, 9.0, np.full(8, 4.0)]
    found = trend(np.repeat([0.5, 1.5, 2.5], [6, 2, 8]), values, np.arange(4.0))
    assert found.centre == pytest.approx([0.5, 2.5])  # the slice of two samples is left out
    assert found.mean == pytest.approx([2.5, 4.0])
    assert found.error == pytest.approx([np.std(np.arange(6.0), ddof=1) / np.sqrt(6), 0.0])
