"""Numbers as text, and times as the page shows them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magtensor.report.clock import clock, instant
from magtensor.report.drawing import label
from magtensor.report.tables import compact, count, named, number, pretty, with_std


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.30097, "0.3010"), (0.01, "0.01"), (-1234.56, "−1235"), (0, "0"), (1.5e-7, "1.500 × 10⁻⁷"),
        (-2.5e9, "−2.500 × 10⁹"), (math.nan, "–"), (None, "–"), (math.inf, "∞"), ("x", "–"), (True, "–"), (7, "7"),
        (9.99999, "10.00"),
    ],
)  # fmt: skip
def test_number(value: object, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (1.02345, 0.00123, "1.0234 ± 0.0012"), (-60.13, 12.0, "−60 ± 12"), (5.0, math.nan, "5"), (math.nan, 1.0, "–"),
        (1.0, 0.0, "1"), (1.0, 1e-14, "1 ± 1.0 × 10⁻¹⁴"), (3e12, 2e3, "3.00000 × 10¹² ± 2000"),
    ],
)  # fmt: skip
def test_with_std(value: float, std: float, text: str) -> None:
    assert with_std(value, std) == text


def test_units_and_counts_as_one_writes_them() -> None:
    assert [pretty(u) for u in ("nT2/m2", "nT/m", "deg", "1", "degC", "")] == ["nT²/m²", "nT/m", "°", "", "°C", ""]
    assert count(1234567) == "1\u202f234\u202f567"
    assert named("contrast_rms_S2_nT") == ("contrast rms S2", "nT") and named("fit_rms") == ("fit rms", "")
    assert compact({"a": [1, 2.5], "b": None, "c": {"d": "e"}}) == "a: 1, 2.5, c: d: e"


def test_clock_takes_the_unit_that_suits_and_names_the_first_sample() -> None:
    units = "seconds since 2026-03-21T09:00:00Z"
    for span, unit, scale in ((10.0, "s", 1.0), (3600.0, "min", 60.0), (86400.0, "h", 3600.0), (1e6, "d", 86400.0)):
        axis = clock(np.array([60.0, 60.0 + span]), units)
        assert (axis.unit, axis.scale) == (unit, scale)
        assert axis.values == pytest.approx([0.0, span / scale])
        assert axis.label.endswith("since 2026-03-21 09:01:00 UTC")


@pytest.mark.parametrize("units", ["", "s", "furlongs since 2020-01-01", "seconds since noon"])
def test_a_time_without_an_epoch_is_in_seconds(units: str) -> None:
    assert instant(12.5, units) == "the survey's 12.5 s"


def test_a_time_beyond_the_calendar_is_in_seconds() -> None:
    assert instant(1e15, "seconds since 2020-01-01T00:00:00Z") == "the survey's 1e+15 s"


def test_labels_are_one_short_printable_line() -> None:
    assert label("a\nb\x00") == "a\ufffdb\ufffd"
    assert len(label("x" * 300)) == 28
    assert not label("_hidden").startswith("_")
