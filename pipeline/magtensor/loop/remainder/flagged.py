"""Samples that nothing explains, which no calibration had a part of: when, how large, on which sensors."""

from __future__ import annotations

import numpy as np

from magtensor.accuracy import figure
from magtensor.calibration.types import Array, Mask
from magtensor.error_models.excitation import Excitation
from magtensor.in_a_row import in_a_row
from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.fitting.model import Adopted, Record, State, unread
from magtensor.loop.fitting.refit import everywhere
from magtensor.loop.remainder.sparse_readings import SparseReadings, as_far_as_unread, between_readings
from magtensor.loop.remainder.switches import switched_at

LONGEST_SPIKE = 2  # samples: what lasts longer is no accident of the recording
MANY_FLAGGED = 0.01  # of the samples: of what is left, some is in these
HYSTERESIS = "hysteresis"
FILTERS = ("bandwidth", "eddy_current")
DIED_AWAY = 7.0  # time constants, in which a thousandth is left
ALIKE = 0.1  # of the mean square along the field, across it: an effect on each sensor shows as much in both
APART = 3.0  # times the white noise of a sensor: a part in which they are not alike
AT_AN_END = 0.95  # of the other samples have smaller, or larger, values on average
ALPHA = 0.001  # of the test whether samples after pauses are bad more often
FAR = 3.0  # times the rms of slow noise: where it wanders furthest it stays for a while


def lasting(bad: Mask, excused: Mask | None = None, longest: int = LONGEST_SPIKE) -> Mask:
    """(N,) samples in runs of bad ones that are longer than a spike and its neighbour, or so many samples, and hold
    none that is excused."""
    out = np.zeros(len(bad), dtype=bool)
    for start, stop in in_a_row(bad):
        out[start:stop] = stop - start > longest and (excused is None or not excused[start:stop].any())
    return out


def after_pauses(bad: Mask, x: Excitation) -> tuple[Mask, str]:
    """(N,) bad samples at the beginnings of runs, if far more of the samples there are bad than of others, and this in
    words; none, and "", otherwise."""
    from scipy.special import bdtrc

    first = np.zeros(len(bad), dtype=bool)
    first[[a for a, b in x.runs()[1:] if b - a > LONGEST_SPIKE]] = True
    pauses, found = int(first.sum()), int((first & bad).sum())
    rest = ~first & ~np.concatenate(([False], first[:-1] & bad[:-1]))
    usual = (int((rest & bad).sum()) + 1.0) / (int(rest.sum()) + 1.0)
    if found <= LONGEST_SPIKE or bdtrc(found - 1, pauses, usual) > ALPHA:
        return np.zeros(len(bad), dtype=bool), ""
    starts = first & bad
    starts[1:] |= starts[:-1] & bad[1:]  # and the next, of what has not come to rest after two
    return starts, f"; they come first after {found} of {pauses} pauses: something has not come to rest then"


def before_the_memory(bad: Mask, state: State) -> tuple[Mask, str]:
    """(N,) bad samples that a survey begins with, while what an adopted hysteresis, or a filter, began with still
    shows, which nobody knows, and this in words; none, and "", otherwise."""
    x, none = state.excitation, np.zeros(len(bad), dtype=bool)
    end = int(np.argmin(bad)) if not bad.all() else len(bad)
    last = max(end - LONGEST_SPIKE, 0)
    name = next((model.name for model in state.adopted if end and last < forgotten_at(model, x)), "")
    if not name:
        return none, ""
    return np.arange(len(bad)) < end, (
        f"{end} samples at the start, in which the state that {name} began with still shows, are flagged and "
        "have no part in the calibration"
    )


def forgotten_at(model: Adopted, x: Excitation) -> int:
    """The number of the first sample in which nothing shows any more of what a model had seen before the survey: 0 of
    one without a memory, or whose beginning is fitted; that of all samples where it always may."""
    if model.name == HYSTERESIS:
        own = [i for i, name in enumerate(x.sensors) if name in (model.sensors or x.sensors)]
        output = x.output[:, own].reshape(len(x.output), -1)
        swept = np.maximum.accumulate(output) - np.minimum.accumulate(output)
        shows = (swept < 2.0 * float(model.settings["half_width_nT"])).any(axis=1)
    elif model.name in FILTERS:
        shows = x.elapsed <= DIED_AWAY * float(model.settings["tau_s"])
    else:
        return 0
    return int(np.count_nonzero(shows))


def unread_words(state: State, record: Record) -> list[str]:
    """How many samples were taken out of use because a log is late or the base station's stamps are wrong, which hardly
    matters for a spike's length."""
    words = []
    shifted = unread(state.adopted, record.time)
    middle = len(shifted) // 2
    late, early = int(shifted[middle:].sum()), int(shifted[:middle].sum())
    if late > LONGEST_SPIKE:
        model = min(state.adopted, key=lambda model: model.shifted_s)
        words.append(
            f"{model.name} acts {-model.shifted_s:.4g} s before what it follows was logged, as where that log is late: "
            f"the last {late} samples, of which it tells nothing, are flagged and have no part in the calibration"
        )
    if early > LONGEST_SPIKE:
        model = max(state.adopted, key=lambda model: model.shifted_s)
        words.append(
            f"{model.name} acts {model.shifted_s:.4g} s after what it follows was logged: the first {early} samples, "
            "of which the log tells nothing, are flagged and have no part in the calibration"
        )
    alone = unread(state.adopted, record.time, record.station) & ~shifted
    if alone.sum() > LONGEST_SPIKE:
        words.append(
            f"the base station, its stamps corrected, has no reading at {int(alone.sum())} samples: they are flagged "
            "and have no part in the calibration"
        )
    return words


def flagged_words(
    flagged: Mask, state: State, record: Record, sparse: SparseReadings | None = None
) -> tuple[str, bool]:
    """How many samples were taken out of use because nothing explains them, when, how large, on which sensors; and
    whether the slow noise of the sensors goes as far, being no outlier of white noise that it is, or all of them lie
    between readings of a base station that is read too seldom."""
    every = everywhere(record, state)
    runs = len(in_a_row(flagged))
    after = record.time[flagged] - record.start
    shared = 0.0 if every.along is None else float(np.mean(every.along[flagged] ** 2))
    own, alike = np.zeros(1), False
    if every.across is not None:
        own = np.mean(every.across[flagged].reshape(int(flagged.sum()), -1, 3) ** 2, axis=(0, 2))
    if every.along is not None and shared > own.max():
        amount = float(np.sqrt(np.mean((every.along[flagged] / every.reference_gain[flagged]) ** 2)))
        usual = OwnNoise(state.residual, None).slow_along()
        alike = every.across is not None and own.max() < ALIKE * shared
        where = " of |b| - F" + (", in all sensors alike" if alike else "")
        if alike and own.max() > APART:
            where += f" but for {_nT(own, every.noise)[int(np.argmax(own))]:.2g} nT"
    else:
        worst = int(np.argmax(own))
        amount = float(_nT(own, every.noise)[worst])
        slow = OwnNoise(state.residual, None).slow_std()[3 * worst : 3 * worst + 3]
        usual = float(np.sqrt(np.mean(slow**2)))
        where = f", mostly on {state.excitation.sensors[worst]}"
    stretches = f"{runs} stretch{'es' * (runs > 1)}"
    words = (
        f"{int(flagged.sum())} samples in {stretches} ({after[0]:.4g} to {after[-1]:.4g} s after the start) fit no "
        f"calibration, by {figure(amount)} nT rms{where}: they are flagged and have no part in the calibration"
        f"{_at_an_end(flagged, state, record)}{between_switches(flagged, state)}"
    )
    if alike and record.station is not None and between_readings(flagged, record):
        away = np.abs(every.along / every.reference_gain) if every.along is not None else np.zeros(len(flagged))
        if sparse is not None or _as_unread(away, flagged, record):
            return f"{words}; they lie between readings of the base station", True
    if amount > FAR * usual:
        return words, False
    return f"{words}; slow noise, {figure(usual)} nT rms there, may reach as far by itself", True


def _as_unread(away: Array, flagged: Mask, record: Record) -> bool:
    """Whether the field may have moved as far away (N,) nT in each run of flagged samples, which the base station did
    not read meanwhile."""
    assert record.station is not None
    apart = record.station.between(record.time).apart_s
    runs = in_a_row(flagged)
    return all(as_far_as_unread(float(away[i:j].max()), float(apart[i]), record) for i, j in runs)


def between_switches(flagged: Mask, state: State) -> str:
    """In words, the channels that were switched when stretches of flagged samples begin and end."""
    elapsed = state.excitation.elapsed
    inside = [i for i in in_a_row(flagged).ravel() if 0 < i < len(elapsed)]
    names = switched_at([float(elapsed[i - 1] + elapsed[i]) / 2.0 for i in inside], state.excitation)
    return f", and begin and end with switchings of {' and '.join(names)}" if names else ""


def _nT(own: Array, noise: Array) -> Array:
    """(S,) nT rms an axis, of mean squares of the sensors (S,) in units of their noise (3 S,)."""
    return np.asarray(np.sqrt(own * np.mean(noise.reshape(-1, 3) ** 2, axis=1)))


def _at_an_end(flagged: Mask, state: State, record: Record) -> str:
    """In words, the channel that an adopted effect follows and that is at its largest or smallest in flagged samples:
    there the law of the effect may be another one."""
    for channel in sorted({c for model in state.adopted for c in model.channels(state.excitation)}):
        if end := end_of(record.logged[channel], flagged):
            return f", mostly where {channel} is {end}: what follows it may not go on there as it was fitted"
    return ""


def end_of(values: Array, flagged: Mask) -> str:
    """Whether a channel (N,) is "largest" or "smallest" where samples (N,) are flagged, of those that are not; "" where
    it is neither, or a vector."""
    column = values.reshape(len(flagged), -1)
    if column.shape[1] != 1 or flagged.all() or not flagged.any():
        return ""
    usual = np.sort(column[~flagged, 0])
    ranks = [np.searchsorted(usual, column[flagged, 0], side) for side in ("left", "right")]
    above = float(np.mean(ranks)) / len(usual)
    return "largest" if above > AT_AN_END else "smallest" if 1.0 - above > AT_AN_END else ""
