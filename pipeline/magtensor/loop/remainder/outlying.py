"""Samples of single sensors that are off by far: spikes, which are left out, and what comes too often for spikes.

What a sensor p alone would have to be off by, to make the residual Q d across the plane, is Q_pp^-1 times its own part
of that; no other sensor can make as much of it, unless there are but two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.accuracy import figure
from magtensor.calibration.joint_together import ABOUT, LEAST_FOR_REJECTION
from magtensor.calibration.types import Array, Mask
from magtensor.loop.evidence.residual import Residual
from magtensor.loop.evidence.stretches import NEIGHBOURS
from magtensor.loop.fitting.model import Record, State, unread
from magtensor.loop.fitting.refit import everywhere
from magtensor.loop.remainder.flagged import ALIKE, LONGEST_SPIKE, MANY_FLAGGED

BEYOND = 5.0  # times the noise of a sensor
FAR_OFF = 20.0  # times the noise of a sensor: no tail of its noise
TIMES = 3.0  # times as many samples as of any other sensor
MOSTLY = 0.7  # of the samples of the sensor that has most
_SINGULAR = 1e-9  # of the largest eigenvalue


@dataclass(frozen=True)
class Outlying:
    """What the sensors of a survey are off by at each sample, believed or not.

    Attributes:
        names: of the sensors; of two, which have one contrast, of both together; none of a single one.
        square: (N, P) of what each of those named would be off by alone, in its noise; off: (N, P, 3) nT, that itself.
        wrong: (N, P) where one is off by more than noise makes, and more than the samples beside it.
        beside: (N,) nT, size of |b| - F where the sensors agree; 0 where it is theirs.
    """

    names: tuple[str, ...]
    square: Array
    off: Array
    wrong: Mask
    beside: Array

    @classmethod
    def of(cls, state: State, record: Record) -> Outlying:
        """Of the state by which it is told what is left."""
        from scipy.ndimage import median_filter

        every, count, names = everywhere(record, state), len(record.time), record.sensors
        size = np.zeros(count) if every.along is None else np.abs(every.along / every.reference_gain)
        if every.across is None:
            return cls((), np.zeros((count, 0)), np.zeros((count, 0, 3)), np.zeros((count, 0), dtype=bool), size)
        square, off = alone(every, every.across)
        apart, _ = alone(every, every.across - median_filter(every.across, size=(NEIGHBOURS, 1), mode="mirror"))
        wrong: Mask = beyond(square) & beyond(apart) & ~unread(state.adopted, record.time, record.station)[:, None]
        if every.along is not None:
            size = size * (np.sum(every.across**2, axis=1) < ALIKE * every.along**2)
        if len(names) == 2:
            return cls((" or ".join(names),), square[:, :1], off[:, :1], wrong[:, :1] | wrong[:, 1:], size)
        return cls(names, square, off, wrong & (square == square.max(axis=1, keepdims=True)), size)

    def too_often(self) -> list[int]:
        """Places of those that are wrong in more samples than spikes are, and in far more than any other."""
        counts = self.wrong.sum(axis=0)
        if len(self.wrong) < LEAST_FOR_REJECTION:
            return []
        return [
            place
            for place, count in enumerate(counts)
            if count > max(MANY_FLAGGED * len(self.wrong), LONGEST_SPIKE)
            and count >= TIMES * np.delete(counts, place).max(initial=0)
        ]


def alone(residual: Residual, across: Array) -> tuple[Array, Array]:
    """(N, S) the square of what each sensor alone would have to be off by, in its noise, and (N, S, 3) nT, that itself.

    Parameters
    ----------
    across: (N, 3 S) whitened.
    """
    sensors = len(residual.noise) // 3
    own = across.reshape(-1, sensors, 3)
    blocks = np.stack([residual.projector[i : i + 3, i : i + 3] for i in range(0, 3 * sensors, 3)])
    off = np.einsum("sij,nsj->nsi", np.linalg.pinv(blocks, rcond=_SINGULAR, hermitian=True), own)
    return np.sum(own * off, axis=2), off * residual.noise.reshape(sensors, 3)


def beyond(squares: Array) -> Mask:
    """(N, S) where squares of three values are beyond all noise, be it as loud as it is there: they have a usual size
    in all samples, and in those about one."""
    from scipy.ndimage import median_filter
    from scipy.special import chdtri

    about = median_filter(squares, size=(ABOUT, 1), mode="mirror")
    usual = np.maximum(about, np.median(squares, axis=0)) * 3.0 / float(chdtri(3, 0.5))
    out: Mask = squares > BEYOND**2 * usual
    return out


def outlying_words(found: Outlying, left_out: Mask) -> tuple[list[str], Mask]:
    """Which sensors are wrong too often for spikes, how often and by how much, and the samples (N,) of these; nothing
    of those whose wrong samples are all left out of the calibration.

    Parameters
    ----------
    left_out: (N,) samples that have no part in the calibration.
    """
    words, told = [], np.zeros(len(left_out), dtype=bool)
    for place in found.too_often():
        wrong = found.wrong[:, place]
        count, used = int(wrong.sum()), int((wrong & ~left_out).sum())
        if not used:
            continue
        told |= wrong
        amount = float(np.sqrt(np.mean(found.off[wrong, place] ** 2)))
        words.append(
            f"{found.names[place]} is off by more than {BEYOND:.0f} times its noise in {count} samples "
            f"({count / len(wrong):.1%}), {figure(amount)} nT rms there, too often for spikes: "
            f"{'all' if used == count else used} of them pass for noise and have a part in the calibration"
        )
    return words, told


def spike_words(found: Outlying, spikes: Mask) -> list[str]:
    """How many samples are left out as spikes, by how much they are off, mostly on which sensors; nothing of few that
    the tails of noise may hold. What is slow goes furthest in single samples too: they are no spikes."""
    worst, at = np.zeros(int(spikes.sum()), dtype=int), np.flatnonzero(spikes)
    size, names, count = found.beside[at], found.names, len(at)
    far = count > LONGEST_SPIKE and bool(names) and np.median(found.square[at].max(axis=1)) > FAR_OFF**2
    if count <= MANY_FLAGGED * len(spikes) and not far:
        return []
    if names:
        worst = np.where(size > 0, len(names), found.square[at].argmax(axis=1))
        own = np.linalg.norm(found.off[at, np.minimum(worst, len(names) - 1)], axis=1)
        size = np.where(size > 0, size, own)
    counts = np.bincount(worst, minlength=len(names) + 1)
    most = [name for name, n in zip((*names, "|b| - F"), counts, strict=True) if n > MOSTLY * counts.max()]
    theirs = at[worst < len(names)]
    by_themselves = not len(theirs) or np.mean(np.any(found.wrong[theirs], axis=1)) > 0.5
    what, as_others = (
        ("spikes", "") if by_themselves else ("single samples", ", and their neighbours are off nearly as far")
    )
    return [
        f"{what}: {count} samples ({count / len(spikes):.1%}) fit no calibration, by {figure(np.median(size))} nT in "
        f"the median, {'mostly ' if counts.max() < count else ''}on {', '.join(most)}{as_others}: they are flagged and "
        "have no part in the calibration"
    ]
