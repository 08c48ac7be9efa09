"""A first mapping for a file nobody has described: guesses from names, units, magnitudes and shapes.

Every guess is written out with its reason, so that the user corrects a proposal instead of starting from nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.errors import DataError
from magtensor.survey.checks import EARTH_FIELD_NT
from magtensor.survey.tables import Column, Tables
from magtensor.survey.time_base import moves_on
from magtensor.survey.times import numbers_to_seconds, parse_instant, split_since
from magtensor.survey.vectors import Floats, Triple, candidates, column_values, numbers_of
from magtensor.units import UnitError, canonical_unit, convert, dimension, is_unit

_TIME_NAMES = re.compile(
    r"^(times?|t|timestamps?|clock|epoch|unix|date.?time|utc|seconds?|secs?|millis|t_\w+|time_\w+)$", re.IGNORECASE
)
_MAGNETIC = re.compile(r"mag|b_|^b\d?_?[xyz]|field|flux|fgm|compass|fluxgate|^h[xyz]", re.IGNORECASE)
_SCALAR = re.compile(
    r"^(?!.*[xyz]$)(.*\b|.*_)?(f|total|scalar|tmi|proton|overhauser|total_field)(\b|_|$)", re.IGNORECASE
)
_KINDS = {
    "acceleration": (re.compile(r"acc", re.IGNORECASE), "acceleration"),
    "angular_rate": (re.compile(r"gyr|gyro|omega|rate", re.IGNORECASE), "angular rate"),
}
_TEMPERATURE = re.compile(r"temp|tmp", re.IGNORECASE)
_CURRENT = re.compile(r"current|curr|amp", re.IGNORECASE)
_EULER = re.compile(r"^(roll|pitch|yaw|heading)", re.IGNORECASE)
_UNIX_SCALES = (("s", 1e9, 4e9), ("ms", 1e12, 4e12), ("us", 1e15, 4e15), ("ns", 1e18, 4e18))
_ROUND_FIELD_NT = 50_000.0  # what a guessed scale makes of the mean magnitude
NO_SENSOR = "S1: {from: [0, 1, 2], units: nT}"
_G_COUNTS = (1.0, 9.81, 1000.0, 2048.0, 4096.0, 8192.0, 16384.0)  # one g in the units and ranges that are usual


@dataclass
class _Guess:
    """Lines of the proposal, and which columns they use."""

    time: list[str] = field(default_factory=list)
    sensors: list[str] = field(default_factory=list)
    channels: list[str] = field(default_factory=list)
    rest: list[str] = field(default_factory=list)
    used: set[str] = field(default_factory=set)


def propose(tables: Tables, file: str, reader: str | None, *, canonical: bool) -> str:
    """The `survey` section of a recipe for this file, as YAML.

    Args:
        tables: the file.
        file: its path, as it shall stand in the recipe.
        reader: to be named in the recipe; None where the file's ending names it.
        canonical: the file needs no mapping.
    """
    head = ["survey:", f"  file: {_quoted(file)}"] + ([f"  reader: {reader}"] if reader else [])
    if canonical:
        return "\n".join([*head, "  # the canonical layout: nothing to map"]) + "\n"
    if all(name.isdigit() for name in tables.columns) and reader in (None, "text"):
        head.append("  options: {header: false}")
    guess = _Guess()
    _time(tables, guess)
    rows = _rows(tables, guess)
    _triples(tables, rows, guess)
    _attitude(tables, rows, guess)
    _scalars(tables, rows, guess)
    lines = [*head, *guess.time]
    if guess.sensors:
        lines += ["  sensors:", *guess.sensors]
    else:
        lines += ["  sensors:", "    # no three columns look like a magnetometer; put them here", f"    {NO_SENSOR}"]
    lines += ["  channels:", *guess.channels] if guess.channels else []
    return "\n".join([*lines, *guess.rest]) + "\n"


def _quoted(text: str | int) -> str:
    """YAML text that reads back as the same name."""
    name = str(text)
    if name.isdigit():
        return name
    plain = re.fullmatch(r"[A-Za-z_./][\w./-]*", name) and name.lower() not in (
        "yes",
        "no",
        "on",
        "off",
        "true",
        "false",
        "null",
        "y",
        "n",
    )
    return name if plain else "'" + name.replace("'", "''") + "'"


def time_candidates(tables: Tables) -> Iterator[tuple[Column, Floats]]:
    """Columns that look like a time base, with their seconds."""
    for name, column in tables.columns.items():
        if len(column.shape) != 1 or name != column.name:  # a reader may give one column a second name
            continue
        name = re.sub(r"\s*[(\[].*[)\]]$", "", name.rsplit("/", 1)[-1])  # `t (s)` is called t
        named = bool(_TIME_NAMES.match(name))
        try:
            stated = column.units is not None and (split_since(column.units) is not None)
        except ValueError:
            stated = False
        if column.text or not (named or stated or name.isdigit()):
            continue
        try:
            values = column.load()
            units = _time_units(column, values)
            if not (named or stated) and (units is None or _unix_unit(values) is None):
                continue
            parts = split_since(units or "s")
            seconds = numbers_to_seconds(values, parts[0] if parts else units or "s")
        except (DataError, ValueError):
            continue
        if len(seconds) < 2 or moves_on(seconds).mean() > 0.5:
            yield column, seconds


def _time_units(column: Column, values: NDArray[Any]) -> str | None:
    if column.units is not None:
        return column.units
    unix = _unix_unit(values)
    if unix:
        return unix
    tail = column.name.rsplit("_", 1)[-1] if "_" in column.name else ""
    try:
        return tail if tail and dimension(tail) == "time" else None
    except UnitError:
        return None


def _unix_unit(values: NDArray[Any]) -> str | None:
    """The unit in which these would be times since 1970 between 2001 and 2096."""
    finite = values[np.isfinite(values.astype(np.float64))]
    if finite.size == 0:
        return None
    middle = float(np.median(finite))
    return next((unit for unit, low, high in _UNIX_SCALES if low < middle < high), None)


def _weight(tables: Tables, rows: int) -> int:
    """How many numbers a row holds in all columns of so many rows: an array has more of them than a base station."""
    return sum(int(np.prod(c.shape[1:])) for c in tables.columns.values() if c.shape and c.shape[0] == rows)


def _time(tables: Tables, guess: _Guess) -> None:
    for column, seconds in sorted(time_candidates(tables), key=lambda found: -_weight(tables, len(found[1]))):
        guess.used.add(column.name)
        own = column.name == "time" and column.units is not None and split_since(column.units) is not None
        if own:
            return  # the mapping finds it by itself
        units = _time_units(column, column.load())
        entry = f"from: {_quoted(column.name)}"
        if column.units is None:
            entry += f", units: {units or 's'}"
        if _unix_unit(column.load()):
            entry += ", epoch: unix"
        note = "" if units else "  # the unit is a guess"
        guess.time.append(f"  time: {{{entry}}}{note}")
        if not moves_on(seconds).all():
            guess.rest.append("# times repeat or step back: the stage load needs `time_faults: drop`")
        return
    for names in _instants(tables):
        guess.used |= set(names)
        guess.time.append(f"  time: {{from: {_refs(names)}}}")
        return
    for name, value in tables.attributes.items():
        if "rate" in str(name).lower() and isinstance(value, int | float) and value > 0:
            guess.time.append(f"  time: {{rate_Hz: {_quoted(str(name))}}}  # an attribute of the file: {value:.6g}")
            return
    guess.time.append("  time: {rate_Hz: 10}  # no time column was found: put the right rate here")


def _instants(tables: Tables) -> Iterator[tuple[str, ...]]:
    """Text columns that are ISO 8601 times: one of them, or a date and a clock."""
    texts = {c.name: c.load() for c in tables.columns.values() if c.text and len(c.shape) == 1 and c.shape[0]}
    for date, days in texts.items():
        if not _is_instant(str(days[0])):
            continue
        for clock, hours in texts.items():
            if clock != date and len(hours) == len(days) and _is_instant(f"{days[0]} {hours[0]}"):
                yield date, clock
        if len(days) < 2 or days[0] != days[1]:
            yield (date,)


def _is_instant(text: str) -> bool:
    try:
        parse_instant(text)
    except ValueError:
        return False
    return True


def _rows(tables: Tables, guess: _Guess) -> int:
    """How many rows the survey has: as many as its time base, else the most common length."""
    if guess.used:
        return tables.columns[next(iter(guess.used))].shape[0]
    lengths = [c.shape[0] for c in tables.columns.values() if c.shape]
    return max(set(lengths), key=lengths.count) if lengths else 0


def _stated_units(label: str, units: str | None) -> str | None:
    """Units from the file, or from the end of a column's name (`mag1_*_nT`)."""
    if units is not None and is_unit(units):
        return canonical_unit(units)
    tail = re.split(r"[_\s(\[]", label.rstrip(")]"))[-1]
    return canonical_unit(tail) if tail != label and is_unit(tail) else None


def _triples(tables: Tables, rows: int, guess: _Guess) -> None:
    sensors = 0
    for triple in candidates(tables, rows, guess.used):
        units = _stated_units(triple.label, triple.units)
        kind = dimension(units) if units else ""
        refs = _refs(triple.refs)
        channel = next(
            (n for n, (pattern, of) in _KINDS.items() if kind == of or (not kind and pattern.search(triple.label))),
            None,
        )
        guess.used |= {r.split("[")[0] for r in triple.refs}
        if channel is not None:
            if any(line.lstrip().startswith(f"{channel}:") for line in guess.channels):
                continue
            entry, why = _channel_scale(channel, units, triple)
            guess.channels.append(f"    {channel}: {{from: {refs}, {entry}}}{why}")
        elif kind == "magnetic flux density" or _MAGNETIC.search(triple.label) or (not kind and _earthlike(triple)):
            sensors += 1
            entry, why = _field_scale(units, triple)
            guess.sensors.append(f"    S{sensors}: {{from: {refs}, {entry}}}{why}")
        else:
            guess.used -= {r.split("[")[0] for r in triple.refs}


def _earthlike(triple: Triple) -> bool:
    """Nothing in the names, but a sphere; or the Earth's field in nT or uT."""
    low, high = EARTH_FIELD_NT
    return not triple.named or low <= triple.radius <= high or low <= 1000 * triple.radius <= high


def _refs(refs: tuple[str, ...]) -> str:
    quoted = [_quoted(r) for r in refs]
    return quoted[0] if len(quoted) == 1 else f"[{', '.join(quoted)}]"


def _field_scale(units: str | None, triple: Triple) -> tuple[str, str]:
    length = triple.radius if np.isfinite(triple.misfit) else float(np.median(np.linalg.norm(triple.values, axis=1)))
    if units is not None and dimension(units) == "magnetic flux density":
        return f"units: {units}", ""
    low, high = EARTH_FIELD_NT
    counts = bool((triple.values == np.round(triple.values)).all())  # whole numbers are nT or a converter's counts
    for name in ("nT",) if counts else ("nT", "uT", "mG", "G", "mT", "T"):
        if low <= float(convert(length, name, "nT")) <= high:
            return f"units: {name}", f"  # guessed from the magnitude, {length:.4g}"
    scale = _ROUND_FIELD_NT / length if length > 0 else 1.0
    why = "  # a guess that makes the field 50 uT: put the data sheet's scale here"
    if not triple.named and any(abs(length / g - 1) < 0.15 for g in _G_COUNTS):
        why += "; or is it an accelerometer?"
    return f"units: nT, scale: {scale:.6g}", why


def _channel_scale(channel: str, units: str | None, triple: Triple) -> tuple[str, str]:
    wanted = {"acceleration": "m s-2", "angular_rate": "rad s-1"}[channel]
    if units is not None and dimension(units) == dimension(wanted):
        return f"units: {units}", ""
    if channel == "acceleration":
        one_g = min(_G_COUNTS, key=lambda g: abs(np.log(triple.radius / g)))
        name = {1.0: "g", 9.81: "m/s2", 1000.0: "mg"}.get(one_g)
        entry = f"units: {name}" if name else f"units: g, scale: 1/{one_g:.0f}"
        return entry, f"  # guessed from the magnitude, {triple.radius:.4g}"
    return f"units: {wanted}", "  # the units are a guess"


def _attitude(tables: Tables, rows: int, guess: _Guess) -> None:
    for column in tables.columns.values():
        if column.name in guess.used or column.shape != (rows, 4):
            continue
        values = numbers_of(column)
        if values is not None and abs(np.nanmedian(np.linalg.norm(values, axis=1)) - 1) < 0.01:
            guess.used.add(column.name)
            guess.rest.append(f"  attitude: {{from: {_quoted(column.name)}, scalar: first}}  # check: first or last?")
            return
    angles = {}
    for column in tables.columns.values():
        match = _EULER.match(column.name)
        if match and column.shape == (rows,) and not column.text:
            angles[match[1].lower().replace("heading", "yaw")] = column
    if set(angles) == {"roll", "pitch", "yaw"}:
        unit = "rad" if max(np.nanmax(np.abs(column_values(c))) for c in angles.values()) < 7 else "deg"
        entries = ", ".join(f"{n}: {_quoted(angles[n].name)}" for n in ("roll", "pitch", "yaw"))
        guess.rest.append(f"  attitude: {{euler: {{{entries}, units: {unit}}}, world: NED}}")
        guess.used |= {c.name for c in angles.values()}


def _scalars(tables: Tables, rows: int, guess: _Guess) -> None:
    reference = False
    names: set[str] = set()
    for column in tables.columns.values():
        if column.name in guess.used or column.shape != (rows,):
            continue
        values = numbers_of(column)
        if values is None or not np.isfinite(values).any():
            continue
        last = column.name.rsplit("/", 1)[-1]
        units = _stated_units(column.name, column.units)
        unit = _total_field_units(values, units)
        named = bool(_SCALAR.search(last)) or (last[-1:] in "FS" and column.units == "nT")
        if not reference and not column.name.isdigit() and named and unit:
            reference = True
            guess.rest.append(f"  reference: {{total_field: {{from: {_quoted(column.name)}, units: {unit}}}}}")
            continue
        name = _channel_name(last, units, names)
        names.add(name)
        entry = f"from: {_quoted(column.name)}" + (f", units: {_quoted(units)}" if units else "")
        if name == "temperature" or name.startswith("current_"):
            needed = "degC" if name == "temperature" else "A"
            if units is None or dimension(units) != dimension(needed):
                entry = f"from: {_quoted(column.name)}, units: {needed}"
        guess.channels.append(f"    {name}: {{{entry}}}")
    reference = reference or _other_reference(tables, rows, guess)
    if not reference:
        guess.rest.append("  # a total field is needed to calibrate against, for instance:")
        guess.rest.append("  # reference: {constant: {value: 50000, units: nT, why: ...}}")


def _other_reference(tables: Tables, rows: int, guess: _Guess) -> bool:
    """A total field with a time base of its own in the same file."""
    for clock, seconds in time_candidates(tables):
        if len(seconds) == rows:
            continue
        for column in tables.columns.values():
            values = numbers_of(column) if column.shape == clock.shape and column.name != clock.name else None
            if values is None or not (units := _total_field_units(values, _stated_units(column.name, column.units))):
                continue
            stated = _time_units(clock, clock.load())
            entry = f"from: {_quoted(clock.name)}" + ("" if clock.units else f", units: {stated or 's'}")
            entry += ", epoch: unix" if not clock.units and _unix_unit(clock.load()) else ""
            guess.rest += [
                "  reference:",
                f"    time: {{{entry}}}",
                f"    total_field: {{from: {_quoted(column.name)}, units: {units}}}",
            ]
            return True
    return False


def _total_field_units(values: Floats, units: str | None) -> str | None:
    """The units in which a steady column is the Earth's total field."""
    median, low, high = float(np.nanmedian(values)), *EARTH_FIELD_NT
    for unit in [units] if units else ["nT", "uT"]:
        if dimension(unit) == "magnetic flux density" and low <= float(convert(median, unit, "nT")) <= high:
            return unit
    return None


def _channel_name(name: str, units: str | None, taken: set[str]) -> str:
    kind = dimension(units) if units else ""
    stem, _, tail = name.rpartition("_")
    plain = re.sub(r"\W+", "_", stem if stem and is_unit(tail) else name).strip("_").lower() or "channel"
    if plain.isdigit():
        plain = f"channel_{plain}"
    if kind == "temperature" or (not kind and _TEMPERATURE.search(name)):
        plain = plain if "temperature" in taken else "temperature"
    elif kind == "electric current" or (not kind and _CURRENT.search(name)):
        plain = plain if plain.startswith("current_") else f"current_{re.sub('_?current_?', '', plain) or 'main'}"
    from magtensor.survey.sections import RESERVED

    while plain in taken or plain in RESERVED:
        plain += "_"
    return plain
