"""The page's tables and facts, as text ready to be set; nothing here draws."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from magtensor.accuracy import COMPONENTS
from magtensor.calibrated import MATRIX_ENTRIES, OFFSET_ENTRIES
from magtensor.report.clock import instant
from magtensor.report.content import Content, decoded

BLOCKS = {"fit": "calibrated", "held_out": "held-out blocks", "verify": "verification survey"}
INVARIANTS = {"I1_nT2_per_m2": ("I1", "nT²/m²"), "I2_nT3_per_m3": ("I2", "nT³/m³")}
UNKNOWN = "–"
SUPERSCRIPTS = str.maketrans("0123456789-+", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺")
MOST_FLAG_ROWS = 40


@dataclass(frozen=True)
class Row:
    """One line: what it is about, its units, and a cell for each column; `strong` for sums over the others."""

    label: str
    units: str
    cells: Sequence[str]
    strong: bool = False


@dataclass(frozen=True)
class Table:
    """A table whose first two columns are a label and units.

    Attributes:
        columns: headings of the cells.
        groups: (heading, rows); the heading may be "".
        title: of the whole, or "".
    """

    columns: Sequence[str]
    groups: Sequence[tuple[str, Sequence[Row]]]
    title: str = ""


def number(value: Any, digits: int = 4) -> str:
    """A number to so many significant digits; powers of ten where it is very large or small."""
    if not isinstance(value, (int, float, np.integer, np.floating)) or isinstance(value, bool):
        return UNKNOWN
    value = float(value)
    if math.isnan(value):
        return UNKNOWN
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)
    if power >= 6 or power < -4:
        return f"{mantissa} × 10{str(power).translate(SUPERSCRIPTS)}".replace("-", "−")
    text = f"{value:.{max(digits - 1 - power, 0)}f}"
    if "." in text and float(text) == value:  # nothing was rounded: the zeros would claim a precision
        text = text.rstrip("0").rstrip(".")
    return text.replace("-", "−")


def with_std(value: float, std: float) -> str:
    """`1.0234 ± 0.0012`: the deviation to two digits and the value to the same place."""
    if not math.isfinite(value):
        return UNKNOWN
    if not (math.isfinite(std) and std > 0):
        return number(value, 6)
    places = 1 - math.floor(math.log10(std))
    if places > 9 or abs(value) >= 1e9:
        return f"{number(value, 6)} ± {number(std, 2)}"
    return f"{value:.{max(places, 0)}f} ± {std:.{max(places, 0)}f}".replace("-", "−")


def count(value: int) -> str:
    """An integer with thin spaces between thousands."""
    return f"{value:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def errors(content: Content) -> Table | None:
    """The error figures: raw output, then each block of the verdict, before and after effects were adopted."""
    if content.outcome is None:
        return None
    columns = [*_raw_column(content), *_verdict_columns(content.outcome["error"])]
    if not any(block for _, block in columns):
        return None
    columns += _noise_column(content)
    groups = []
    for key, heading, units in (
        ("total_field_rms_nT", "total field, rms of |b| − F", "nT"),
        ("tensor_rms_nT_per_m", "tensor, rms", "nT/m"),
        ("invariant_rms", "invariants, rms", ""),
    ):
        names = list(dict.fromkeys(n for _, block in columns for n in (block.get(key) or {})))
        rows = []
        for name in names:
            shown, of = INVARIANTS.get(name, (name, units)) if key == "invariant_rms" else (name, units)
            cells = [number((block.get(key) or {}).get(name)) for _, block in columns]
            rows.append(Row("all" if name == "all" else shown, of, cells, name == "all"))
        if rows:
            groups.append((heading, rows))
    samples = [count(b["samples"]) if isinstance(b.get("samples"), int) else UNKNOWN for _, b in columns]
    groups.append(("", [Row("samples in use", "", samples)]))
    return Table([heading for heading, _ in columns], groups)


def _verdict_columns(blocks: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    columns: list[tuple[str, Mapping[str, Any]]] = []
    for name, block in blocks.items():
        if not isinstance(block, Mapping):
            continue
        heading = BLOCKS.get(name, name)
        if "before" not in block and "after" not in block:
            columns.append((heading, block))
            continue
        before, after = block.get("before") or {}, block.get("after") or {}
        if not (before or after):  # the survey could not be used
            continue
        if before == after:  # nothing was adopted: one figure, not two equal ones
            columns.append((heading, after))
        else:
            columns += [(f"{heading}: declared model", before), (f"{heading}: with adopted effects", after)]
    return columns


def _raw_column(content: Content) -> list[tuple[str, Mapping[str, Any]]]:
    before = content.in_use("residual/total_field_before")
    if before is None:
        return []
    known = np.isfinite(before)
    figures = {s: _rms(before[known[:, i], i]) for i, s in enumerate(content.sensors)}
    samples = int(known.all(axis=1).sum())
    return [("raw output", {"total_field_rms_nT": figures | {"all": _rms(before[known])}, "samples": samples})]


def _noise_column(content: Content) -> list[tuple[str, Mapping[str, Any]]]:
    """What the sensors' white noise alone would give: no calibration can do better."""
    noise, gain = content.noise_of_axes, content.variable("calibration/tensor_gain")
    if not noise.size or not np.isfinite(noise).all():
        return []
    each = content.noise
    block: dict[str, Any] = {
        "total_field_rms_nT": dict(zip(content.sensors, each, strict=True)) | {"all": _rms(each)},
    }
    if gain is not None:
        of = np.sqrt(np.einsum("rcsa,sa->rc", gain**2, noise**2))
        block["tensor_rms_nT_per_m"] = {name: of["xyz".index(name[0]), "xyz".index(name[1])] for name in COMPONENTS} | {
            "all": _rms(of)
        }
    return [("noise alone", block)]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


@dataclass(frozen=True)
class Judgement:
    """A QC verdict as shown."""

    state: str
    name: str
    value: str
    limit: str
    units: str
    words: str


ORDER = ("fail", "warn", "pass")


def judgements(content: Content) -> list[Judgement]:
    """The QC verdicts, the worst first, otherwise in their own order."""
    names, states = content.names("qc/metric"), content.names("qc/state")
    words, units = content.names("qc/words"), content.names("qc/units")
    value, limit = content.variable("qc/value"), content.variable("qc/limit")
    if not names or value is None or limit is None:
        return []
    found = [
        Judgement(s if s in ORDER else "warn", n, number(v), number(w), "" if u == "1" else pretty(u), t)
        for s, n, v, w, u, t in zip(states, names, value, limit, units, words, strict=True)
    ]
    return sorted(found, key=lambda j: ORDER.index(j.state))


def pretty(units: str) -> str:
    """Units as one writes them: nT²/m² for nT2/m2."""
    out = "".join(
        c.translate(SUPERSCRIPTS) if c.isdigit() and i and units[i - 1].isalpha() else c for i, c in enumerate(units)
    )
    return {"deg": "°", "degC": "°C", "1": ""}.get(out, out)


def parameters(content: Content) -> list[Table]:
    """Every variable of the calibration over (sensor, ..._parameter), with its deviations; angles in deg and rad."""
    if "calibration" not in content.survey.tree.children:
        return []
    dataset = content.survey.tree["calibration"].to_dataset()
    tables = []
    for name in sorted(str(v) for v in dataset.data_vars):
        dims = tuple(str(d) for d in dataset[name].dims)
        if len(dims) != 2 or dims[0] != "sensor" or not dims[1].endswith("parameter") or name.endswith("_std"):
            continue
        values, std = content.variable(f"calibration/{name}"), content.variable(f"calibration/{name}_std")
        if values is None or not values.size:
            continue
        entries = content.names(f"calibration/{dims[1]}") or [str(k) for k in range(values.shape[1])]
        units = _units_of_each(content, name, dims[1], entries)
        spread = np.full_like(values, np.nan) if std is None or std.shape != values.shape else std
        rows: list[Row] = []
        for k, (entry, unit) in enumerate(zip(entries, units, strict=True)):
            column, deviation = values[:, k], spread[:, k]
            if unit == "rad":
                rows.append(Row(entry, "°", _cells(np.degrees(column), np.degrees(deviation))))
            rows.append(Row("" if unit == "rad" else entry, pretty(unit), _cells(column, deviation)))
        title = str(dataset[name].attrs.get("long_name", f"parameters of {name.replace('_', ' ')}"))
        tables.append(Table(content.sensors, [("", rows)], title=title))
    return tables


def _cells(values: Iterable[float], std: Iterable[float]) -> list[str]:
    return [with_std(float(v), float(s)) for v, s in zip(values, std, strict=True)]


def _units_of_each(content: Content, name: str, dim: str, entries: Sequence[str]) -> list[str]:
    """The units of each parameter: a JSON attribute of the variable or its coordinate, else the variable's own."""
    for path in (f"calibration/{name}", f"calibration/{dim}"):
        for attribute in ("units_of_each", "units"):
            found = content.listed(path, attribute)
            if isinstance(found, dict):
                return [str(found.get(e, "")) for e in entries]
            if isinstance(found, list) and len(found) == len(entries):
                return [str(u) for u in found]
    # a unit such as "1" is JSON as well, hence only now
    return [str(content.attributes(f"calibration/{name}").get("units", ""))] * len(entries)


def correction(content: Content) -> Table | None:
    """Matrix and offset of each sensor with standard deviations from the covariance."""
    matrix, offset = content.variable("calibration/matrix"), content.variable("calibration/offset")
    if matrix is None or offset is None:
        return None
    values = np.concatenate([matrix.reshape(len(matrix), 9), offset], axis=1)
    covariance = content.variable("calibration/covariance")
    std = np.full(values.shape, np.nan)
    if covariance is not None and covariance.shape == (values.size, values.size):
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0)).reshape(values.shape)
    entries = [e.replace("_", " ") for e in (*MATRIX_ENTRIES, *OFFSET_ENTRIES)]
    rows = [Row(e, "nT" if k >= 9 else "", _cells(values[:, k], std[:, k])) for k, e in enumerate(entries)]
    return Table(content.sensors, [("", rows)])


def per_sensor(content: Content) -> Table | None:
    """Every figure of the calibration that each sensor has one of, and the noise of its axes."""
    rows = []
    if "calibration" in content.survey.tree.children:
        dataset = content.survey.tree["calibration"].to_dataset()
        for name in sorted(str(v) for v in dataset.data_vars):
            values = content.variable(f"calibration/{name}") if dataset[name].dims == ("sensor",) else None
            if values is not None:
                title, units = named(name)
                if "units" in dataset[name].attrs:
                    title = str(dataset[name].attrs.get("long_name", title))
                    units = str(dataset[name].attrs["units"])
                rows.append(Row(title, pretty(units), [number(v) for v in values]))
    noise = content.noise_of_axes
    if np.isfinite(noise).any():
        rows += [Row(f"noise of axis {a}", "nT", [number(v) for v in noise[:, k]]) for k, a in enumerate("xyz")]
    return Table(content.sensors, [("", rows)]) if rows else None


def named(key: str) -> tuple[str, str]:
    """`("contrast rms S2", "nT")` of `contrast_rms_S2_nT`: methods put the units of a figure at the end of its name."""
    head, _, tail = key.rpartition("_")
    if head and tail in ("nT", "m", "deg", "rad", "s"):
        return head.replace("_", " "), tail
    return key.replace("_", " "), ""


@dataclass(frozen=True)
class FlagGroup:
    """All flags that one stage set for one reason on one sensor."""

    by: str
    reason: str
    sensor: str
    runs: str
    samples: str
    share: str
    first: str
    last: str


def flag_groups(content: Content) -> tuple[list[FlagGroup], int]:
    """The flag record gathered by stage, reason and sensor, most samples first; and how many groups are not shown."""
    gathered: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for flag in content.flags:
        gathered.setdefault((str(flag["by"]), str(flag["reason"]), str(flag["sensor"])), []).append(flag)
    ordered = sorted(gathered.items(), key=lambda item: (-sum(int(f["samples"]) for f in item[1]), item[0]))
    total = len(content.time)
    groups = []
    for (by, reason, sensor), flags in ordered[:MOST_FLAG_ROWS]:
        samples = sum(int(f["samples"]) for f in flags)
        first, last = min(float(f["start"]) for f in flags), max(float(f["stop"]) for f in flags)
        groups.append(
            FlagGroup(
                by, reason, sensor or "whole array", count(len(flags)), count(samples),
                f"{samples / total:.2%}" if total else UNKNOWN,
                instant(first, content.time_units), instant(last, content.time_units),
            )
        )  # fmt: skip
    return groups, len(ordered) - len(groups)


def attitudes(content: Content) -> Table | None:
    """What the attitudes of each sensor can determine, judged from its calibrated field."""
    from magtensor.calibration.postures import NAMED

    if not content.coverage:
        return None
    rows: dict[str, list[str]] = {}
    for found in content.coverage:
        if found is None:
            cells = ["fewer than ten samples", *[UNKNOWN] * 5]
        else:
            unseen = ", ".join(found.unseen) or "none"
            cone = str(found.empty_cones[0]) if found.empty_cones else "none wider than 30 deg"
            further = str(found.further) or "none: well spread"
            error = " → ".join(f"{e:.3g}" if np.isfinite(e) else "unknown" for e in found.further.error[: NAMED + 1])
            cells = [count(found.distinct), number(found.condition_number, 3), unseen, cone, further, error]
        headings = (
            "distinct attitudes", "condition number", "half axes never seen", "largest cone without a sample",
            "postures that would help most", "worst error of |b|, now → after each, times a sample's noise",
        )  # fmt: skip
        for heading, cell in zip(headings, cells, strict=True):
            rows.setdefault(heading, []).append(cell)
    return Table(content.sensors, [("", [Row(k, "", v) for k, v in rows.items()])])


def unobservable(content: Content) -> list[str]:
    """What the data leave free, in the calibration's words."""
    found = content.listed("calibration/matrix", "unobservable")
    return [str(w) for w in found] if isinstance(found, list) else []


def diagnostics(content: Content) -> list[tuple[str, str]]:
    """Further figures of the calibration and how the tensor was assembled."""
    found = content.listed("calibration/matrix", "diagnostics")
    shown = [
        (named(str(k))[0], f"{number(v, 5)} {named(str(k))[1]}".rstrip() if isinstance(v, (int, float)) else str(v))
        for k, v in (found.items() if isinstance(found, dict) else ())
        if v != ""
    ]
    facts = content.attributes("calibration/matrix")
    if "method" in facts:
        shown.insert(0, ("method", str(facts["method"])))
    gain = content.attributes("calibration/tensor_gain")
    if "method" in gain:
        shown.append(("tensor assembled by", str(gain["method"])))
    if "centre_m" in gain:
        centre = np.atleast_1d(np.asarray(gain["centre_m"], dtype=float))
        shown.append(("tensor at (m)", ", ".join(number(float(x)) for x in centre)))
    for note in decoded(gain.get("notes")) or []:
        shown.append(("note on the tensor", str(note)))
    return shown


def compact(value: Any) -> str:
    """A value of a recipe or a verdict on one line; nothing for nothing."""
    if value in (None, {}, [], ""):
        return ""
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {shown}" for k, v in value.items() if (shown := compact(v)))
    if isinstance(value, list):
        return ", ".join(compact(v) for v in value)
    if isinstance(value, float):
        return number(value, 5)
    return str(value) if isinstance(value, (str, int)) else json.dumps(value, default=str)


def coefficient(entry: Mapping[str, Any]) -> str:
    """One adopted coefficient: sensor, name, value with its deviation, units."""
    value, std = (float(entry.get(k, math.nan)) for k in ("value", "std"))
    head = " ".join(str(entry[k]) for k in ("sensor", "name") if entry.get(k))
    return f"{head}: {with_std(value, std)} {pretty(str(entry.get('units', '')))}".strip()
