"""The flag record: which samples are not used, who said so, and why. Flagged samples keep their values."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.in_a_row import in_a_row

MUCH = 0.1  # of a survey's samples: a loss that is told at once


@dataclass(frozen=True)
class Flag:
    """A range of samples taken out of use.

    Attributes:
        start, stop: seconds on the survey's time axis, first and last flagged sample.
        samples: how many samples the range holds.
        sensor: the sensor's name, "" for the whole array.
        by: the stage that set it.
        reason: one clause.
    """

    start: float
    stop: float
    samples: int
    sensor: str
    by: str
    reason: str

    def as_dict(self) -> dict[str, object]:
        return asdict(self)


def flag_ranges(
    time: NDArray[np.float64], bad: NDArray[np.bool_], *, by: str, reason: str, sensor: str = "", most: int = 1000
) -> list[Flag]:
    """One flag for each run of consecutive bad samples; beyond `most` runs the rest is one flag.

    Args:
        time: (N,) s.
        bad: (N,) True where the sample is taken out of use.
        by: the stage.
        reason: one clause.
        sensor: name, "" for the whole array.
        most: runs recorded singly.
    """
    starts, stops = in_a_row(bad).T
    flags = [
        Flag(float(time[a]), float(time[b - 1]), int(b - a), sensor, by, reason)
        for a, b in zip(starts[:most], stops[:most], strict=True)
    ]
    if len(starts) > most:
        a, b = starts[most], stops[-1]
        count = int(bad[a:].sum())
        flags.append(
            Flag(
                float(time[a]), float(time[b - 1]), count, sensor, by, f"{reason} (and {len(starts) - most} more runs)"
            )
        )
    return flags


def summary(flags: Iterable[Flag]) -> list[str]:
    """One line for each pair of stage and reason: how many samples, of which sensors."""
    return [_line(group) for group in _groups(flags)]


def much_lost(flags: Iterable[Flag], samples: int) -> list[str]:
    """The lines of `summary` that take more than a tenth of a survey's samples from a sensor, each with how many the
    survey has."""
    lost = [group for group in _groups(flags) if max(_of_each(group).values()) > MUCH * samples]
    return [f"{_line(group)} (of {samples})" for group in lost]


def _groups(flags: Iterable[Flag]) -> list[list[Flag]]:
    groups: dict[tuple[str, str], list[Flag]] = {}
    for flag in flags:
        groups.setdefault((flag.by, flag.reason), []).append(flag)
    return list(groups.values())


def _of_each(group: list[Flag]) -> dict[str, int]:
    """How many samples are flagged of each sensor that is named, those of the whole array among them; of "", where none
    is named."""
    sensors = sorted({flag.sensor for flag in group if flag.sensor}) or [""]
    return {name: sum(flag.samples for flag in group if flag.sensor in ("", name)) for name in sensors}


def _line(group: list[Flag]) -> str:
    each = _of_each(group)
    least, most = min(each.values()), max(each.values())
    count = f"{most}" if least == most else f"{least} to {most}"
    whose = f" of {'each of ' * (len(each) > 1)}{', '.join(each)}" if any(each) else ""
    return f"{group[0].by}: {count} samples{whose}: {group[0].reason}"
