"""Units by name: what dimension a name has, and how to get from one to another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import did_you_mean


class UnitError(ValueError):
    """An unknown unit, or one of the wrong dimension. The caller knows where it was written and adds that."""


@dataclass(frozen=True)
class Unit:
    """base value = value * factor + offset, in the base unit of the dimension."""

    dimension: str
    factor: float
    offset: float = 0.0


GRAVITY = 9.80665  # standard gravity, m s-2, exact by definition
_DEGREE = np.pi / 180.0
_FLUX, _LENGTH, _TIME, TEMPERATURE = "magnetic flux density", "length", "time", "temperature"
CURRENT, _VOLTAGE, _ANGLE, _RATE = "electric current", "voltage", "angle", "angular rate"
_ACCELERATION, _PRESSURE, _PURE, _COUNT, _FREQUENCY = "acceleration", "pressure", "pure number", "counts", "frequency"

# Base units: nT, m, s, degC, A, V, rad, rad s-1, m s-2, Pa, 1, counts, Hz, nT m-1. Spelt as the CF convention does.
UNITS: dict[str, Unit] = {
    "nT": Unit(_FLUX, 1.0),
    "pT": Unit(_FLUX, 1e-3),
    "uT": Unit(_FLUX, 1e3),
    "mT": Unit(_FLUX, 1e6),
    "T": Unit(_FLUX, 1e9),
    "G": Unit(_FLUX, 1e5),
    "mG": Unit(_FLUX, 1e2),
    "m": Unit(_LENGTH, 1.0),
    "mm": Unit(_LENGTH, 1e-3),
    "cm": Unit(_LENGTH, 1e-2),
    "km": Unit(_LENGTH, 1e3),
    "s": Unit(_TIME, 1.0),
    "ns": Unit(_TIME, 1e-9),
    "us": Unit(_TIME, 1e-6),
    "ms": Unit(_TIME, 1e-3),
    "min": Unit(_TIME, 60.0),
    "h": Unit(_TIME, 3600.0),
    "d": Unit(_TIME, 86400.0),
    "degC": Unit(TEMPERATURE, 1.0),
    "K": Unit(TEMPERATURE, 1.0, -273.15),
    "degF": Unit(TEMPERATURE, 5.0 / 9.0, -160.0 / 9.0),
    "A": Unit(CURRENT, 1.0),
    "mA": Unit(CURRENT, 1e-3),
    "uA": Unit(CURRENT, 1e-6),
    "V": Unit(_VOLTAGE, 1.0),
    "mV": Unit(_VOLTAGE, 1e-3),
    "uV": Unit(_VOLTAGE, 1e-6),
    "rad": Unit(_ANGLE, 1.0),
    "deg": Unit(_ANGLE, _DEGREE),
    "arcmin": Unit(_ANGLE, _DEGREE / 60.0),
    "rad s-1": Unit(_RATE, 1.0),
    "deg s-1": Unit(_RATE, _DEGREE),
    "m s-2": Unit(_ACCELERATION, 1.0),
    "g": Unit(_ACCELERATION, GRAVITY),
    "mg": Unit(_ACCELERATION, GRAVITY * 1e-3),
    "Pa": Unit(_PRESSURE, 1.0),
    "hPa": Unit(_PRESSURE, 1e2),
    "kPa": Unit(_PRESSURE, 1e3),
    "mbar": Unit(_PRESSURE, 1e2),
    "bar": Unit(_PRESSURE, 1e5),
    "Hz": Unit(_FREQUENCY, 1.0),
    "kHz": Unit(_FREQUENCY, 1e3),
    "1": Unit(_PURE, 1.0),
    "%": Unit(_PURE, 1e-2),
    "counts": Unit(_COUNT, 1.0),
    "nT m-1": Unit("magnetic gradient", 1.0),
    "nT2": Unit("magnetic flux density squared", 1.0),
}

_SAME_AS = {
    "nT": ("nanotesla", "gamma", "gammas"),
    "uT": ("microtesla",),
    "mT": ("millitesla",),
    "T": ("tesla",),
    "G": ("gauss", "Gs"),
    "mG": ("milligauss",),
    "m": ("metre", "metres", "meter", "meters"),
    "mm": ("millimetre", "millimeter"),
    "cm": ("centimetre", "centimeter"),
    "km": ("kilometre", "kilometer"),
    "s": ("sec", "secs", "second", "seconds"),
    "ns": ("nanosecond", "nanoseconds"),
    "us": ("microsecond", "microseconds", "usec"),
    "ms": ("msec", "millisecond", "milliseconds"),
    "min": ("minute", "minutes"),
    "h": ("hr", "hour", "hours"),
    "d": ("day", "days"),
    "degC": ("C", "celsius", "deg_C", "degree_Celsius", "degrees_Celsius", "degree_C", "degrees_C"),
    "K": ("kelvin",),
    "degF": ("fahrenheit", "deg_F", "degree_F"),
    "A": ("amp", "amps", "ampere", "amperes"),
    "mA": ("milliampere",),
    "V": ("volt", "volts"),
    "mV": ("millivolt",),
    "rad": ("radian", "radians"),
    "deg": ("degree", "degrees"),
    "rad s-1": ("rad/s", "rad/sec", "rad s^-1", "rads"),
    "deg s-1": ("deg/s", "deg/sec", "deg s^-1", "dps"),
    "m s-2": ("m/s2", "m/s^2", "m/s**2", "m s^-2", "m/s/s"),
    "Pa": ("pascal",),
    "Hz": ("hertz",),
    "1": ("none", "dimensionless", "unitless", "-"),
    "%": ("percent", "percentRH", "%RH"),
    "counts": ("count", "LSB", "lsb", "ADC", "digit", "digits"),
    "nT m-1": ("nT/m",),
}
_ALIASES = {alias: name for name, aliases in _SAME_AS.items() for alias in aliases}
# Micro signs (two code points), degree sign, superscripts: what people really write in headers.
_SPELLING = str.maketrans({"µ": "u", "μ": "u", "°": "deg", "²": "2", "⁻": "-", "¹": "1", "·": " "})


def canonical_unit(name: str) -> str:
    """The one spelling of a unit used in this package.

    Letter case matters where it tells units apart (G and g, mT and MT); where no exact spelling is known, a
    longer name in other case is taken if only one unit is meant (`NT`, `Gauss`).

    Raises:
        UnitError: the unit is unknown.
    """
    text = " ".join(name.strip().translate(_SPELLING).split())
    if text in UNITS:
        return text
    if text in _ALIASES:
        return _ALIASES[text]
    if len(text) > 1:
        folded = {_ALIASES.get(u, u) for u in (*UNITS, *_ALIASES) if len(u) > 1 and u.lower() == text.lower()}
        if len(folded) == 1:
            return folded.pop()
    raise UnitError(f"unknown unit '{name}'{did_you_mean(text, [*UNITS, *_ALIASES])}")


def is_unit(name: str) -> bool:
    """Whether the name is a known unit."""
    try:
        canonical_unit(name)
    except UnitError:
        return False
    return True


def dimension(name: str) -> str:
    """`"magnetic flux density"` for `"uT"`.

    Raises:
        UnitError: the unit is unknown.
    """
    return UNITS[canonical_unit(name)].dimension


def convert(values: Any, units: str, to: str) -> NDArray[np.float64]:
    """The same quantities in other units; the same array comes back where nothing has to change.

    Args:
        values: any shape, in `units`.
        units: what they are in.
        to: what is wanted.

    Raises:
        UnitError: an unknown unit, or two units of different dimensions.
    """
    new_name = canonical_unit(to)
    try:
        old_name = canonical_unit(units)
    except UnitError as error:
        fitting = [name for name, unit in UNITS.items() if unit.dimension == UNITS[new_name].dimension]
        raise UnitError(f"{error}; {_article(UNITS[new_name].dimension)} may be in {', '.join(fitting)}") from None
    array = np.asarray(values, dtype=np.float64)
    if old_name == new_name:
        return array
    old, new = UNITS[old_name], UNITS[new_name]
    if old.dimension != new.dimension:
        why = "; counts need a `scale` and the units it gives" if old.dimension == _COUNT else ""
        raise UnitError(f"'{units}' is {_article(old.dimension)}, {_article(new.dimension)} in {to} is needed{why}")
    ratio = _ratio(old.factor, new.factor)
    if old.offset == new.offset == 0.0:
        return array * ratio
    return array * ratio + (old.offset - new.offset) / new.factor


def _ratio(old: float, new: float) -> float:
    """old / new, exact for the powers of ten that decimal prefixes give (1e-3 / 1e-9 is not 1e6 in binary)."""
    ratio = old / new
    return round(ratio) if ratio > 1 and abs(ratio - round(ratio)) < 1e-12 * ratio else ratio


def _article(dimension_name: str) -> str:
    if dimension_name == _COUNT:
        return "a raw count"
    return f"{'an' if dimension_name[0] in 'aeiou' else 'a'} {dimension_name}"
