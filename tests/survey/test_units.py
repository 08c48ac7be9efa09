"""Units: what converts into what, and what the messages say when nothing does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magtensor.units import UNITS, UnitError, canonical_unit, convert, dimension, is_unit

FINITE = st.floats(-1e12, 1e12, allow_nan=False)


@pytest.mark.parametrize(
    ("value", "units", "to", "expected"),
    [
        (48.0, "uT", "nT", 48_000.0),
        (0.48, "G", "nT", 48_000.0),
        (480.0, "mG", "nT", 48_000.0),
        (48_000.0, "gamma", "nT", 48_000.0),
        (4.8e-5, "T", "nT", 48_000.0),
        (0.048, "mT", "nT", 48_000.0),
        (25.0, "cm", "m", 0.25),
        (1.5, "km", "m", 1500.0),
        (2.0, "min", "s", 120.0),
        (250.0, "ms", "s", 0.25),
        (273.15, "K", "degC", 0.0),
        (212.0, "degF", "degC", 100.0),
        (-40.0, "degF", "degC", -40.0),
        (180.0, "deg", "rad", np.pi),
        (180.0, "deg/s", "rad/s", np.pi),
        (1.0, "g", "m/s2", 9.80665),
        (1013.25, "hPa", "Pa", 101_325.0),
        (50.0, "%", "1", 0.5),
    ],
)
def test_known_conversions(value: float, units: str, to: str, expected: float) -> None:
    assert convert(value, units, to) == pytest.approx(expected, rel=1e-14, abs=1e-12)


@pytest.mark.parametrize(
    ("written", "meant"),
    [("µT", "uT"), ("μT", "uT"), ("°C", "degC"), ("m/s²", "m s-2"), ("m s^-2", "m s-2"), ("Gauss", "G"), ("NT", "nT"),
     ("nanotesla", "nT"), ("dps", "deg s-1"), (" nT ", "nT"), ("LSB", "counts"), ("milligauss", "mG")],
)  # fmt: skip
def test_spellings(written: str, meant: str) -> None:
    assert canonical_unit(written) == meant


def test_letter_case_tells_units_apart() -> None:
    assert dimension("G") == "magnetic flux density"
    assert dimension("g") == "acceleration"
    assert dimension("mT") == "magnetic flux density"
    assert not is_unit("MG")


@given(FINITE, st.sampled_from(sorted(UNITS)), st.sampled_from(sorted(UNITS)))
def test_there_and_back(value: float, one: str, other: str) -> None:
    if UNITS[one].dimension != UNITS[other].dimension:
        with pytest.raises(UnitError):
            convert(value, one, other)
        return
    scale = abs(UNITS[one].offset / UNITS[one].factor) + abs(UNITS[other].offset / UNITS[one].factor)
    assert convert(convert(value, one, other), other, one) == pytest.approx(value, rel=1e-12, abs=1e-12 * (1 + scale))


@given(st.integers(-(2**40), 2**40))
def test_microtesla_are_exactly_a_thousand_nanotesla(value: int) -> None:
    assert convert(float(value), "uT", "nT") == value * 1000


def test_same_units_give_the_same_array() -> None:
    values = np.array([1.0, np.nan, 0.1])
    assert convert(values, "nT", "gamma") is values


def test_messages() -> None:
    with pytest.raises(UnitError, match=r"unknown unit 'nTesla'.*did you mean"):
        convert(1.0, "nTesla", "nT")
    with pytest.raises(UnitError, match="'degC' is a temperature, a magnetic flux density in nT is needed"):
        convert(1.0, "degC", "nT")
    with pytest.raises(UnitError, match="counts need a `scale`"):
        convert(1.0, "LSB", "nT")
