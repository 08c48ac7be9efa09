"""What a calibration has seen, and which of its effects another survey takes beyond that."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.settings import AnyChannel, profiled
from magtensor.error_models.waveform import NAME
from magtensor.errors import DataError
from magtensor.loop.fitting.model import Adopted, Record
from magtensor.loop.fitting.record import record_of
from magtensor.survey.model import Survey

MOST_BEYOND = 0.25  # of the range that a calibration has seen of a channel, or of its largest outputs
STRAIGHT = 1e-6  # of what an effect adds: rounding


def seen_here(record: Record, adopted: Sequence[Adopted]) -> dict[str, str]:
    """What a calibration keeps of the survey that it was made from, as attributes (JSON): the least and largest value
    of each channel, its origin taken off, and of those that effects see through a lag, those of several columns
    together; and the largest output of each sensor, nT."""
    ranges = {name: [float(v.min()), float(v.max())] for name, v in record.logged.items()}
    for effect in adopted:
        ranges |= {what: [float(v.min()), float(v.max())] for what, _, v in _followed(effect, record)}
    return {"channel_ranges": json.dumps(ranges), "largest_outputs_nT": json.dumps(_largest(record).tolist())}


def extrapolated(
    survey: Survey, calibration: Survey, adopted: Sequence[Adopted], origins: Mapping[str, Array]
) -> dict[str, str]:
    """Which effects go beyond what the calibration has seen, and how far: of a channel that they follow, or of the
    field, with which they do not grow in proportion."""
    known = calibration["calibration/effects"].attrs if adopted else {}
    if "channel_ranges" not in known or not survey.good.any():
        return {}
    record = record_of(survey, origins, use=survey.good)
    here = [a for a in adopted if a.component.effect != "site"]  # what belongs to a site is not taken off
    ranges, largest = (json.loads(str(known.get(of, "[]"))) for of in ("channel_ranges", "largest_outputs_nT"))
    found: dict[str, list[str]] = {}
    for effect in here:
        try:
            words = [*_of_channels(record, effect, ranges), *_of_the_field(record, effect, largest)]
        except (DataError, KeyError):  # what it follows is missing: told where it is to be taken off
            continue
        if words:
            found.setdefault(effect.name, []).extend(words)
    return {name: "; ".join(dict.fromkeys(words)) for name, words in found.items()}


def _of_channels(record: Record, effect: Adopted, seen: Mapping[str, Sequence[float]]) -> list[str]:
    words = []
    for what, channel, values in _followed(effect, record):
        if what not in seen:  # of 2026: channels alone
            what, values = channel, record.logged[channel]
        if what not in seen:
            continue
        low, high = seen[what]
        beyond = max(low - float(values.min()), float(values.max()) - high)
        if beyond > MOST_BEYOND * (high - low):
            units = f" {record.units[channel]}" if record.units[channel] else ""
            words.append(f"{what} goes {beyond:.3g}{units} beyond what the calibration has seen")
    return words


def _of_the_field(record: Record, effect: Adopted, seen: Sequence[float]) -> list[str]:
    largest = _largest(record)
    if len(seen) != len(largest):  # of 2026: none
        return []
    times = float(np.max(largest / np.asarray(seen)))
    if times <= 1.0 + MOST_BEYOND or not _bent(effect, record):
        return []
    return [f"the outputs are {times:.3g} times as large as any that the calibration has seen"]


def _largest(record: Record) -> Array:
    """(S,) nT."""
    out: Array = np.linalg.norm(record.raw, axis=2).max(axis=0)
    return out


def _bent(effect: Adopted, record: Record) -> bool:
    """Whether what an effect adds is no straight line along growing outputs, as it is of offsets, of C and of
    delays."""
    if effect.name == NAME:
        return False
    added = []
    for share in (0.5, 0.75, 1.0):
        x = record.excitation(share * record.raw, share * record.raw)
        added.append(effect.terms(x).series)
    return float(np.abs(added[0] - 2.0 * added[1] + added[2]).max()) > STRAIGHT * float(np.abs(added[2]).max())


def _followed(effect: Adopted, record: Record) -> list[tuple[str, str, Array]]:
    """What an effect follows: in words, the channel, and its values, seen through the effect's lag from equilibrium."""
    x = record.excitation(record.raw, record.raw)
    lag = float(effect.settings.get("lag_s", 0.0))
    out = []
    for name, mark in profiled(effect.component).items():
        if isinstance(mark, AnyChannel):
            channel = str(effect.settings.get(name, "")) or (mark.values(x) or [""])[0]
            if channel in record.logged:
                late = lag > 0.0 and not effect.settings.get("delayed", False)
                values = x.lagged(x.channel(channel), lag) if late else x.channel(channel)
                out.append((f"{channel}, through a lag of {lag:.4g} s," if late else channel, channel, values))
    return out
