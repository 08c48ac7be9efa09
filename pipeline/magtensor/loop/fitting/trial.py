"""The third gate: what an adoption does once everything is fitted anew, to every sensor, on blocks it has not seen.

The first two gates look at a residual as the fit leaves it, in noise of its own colour. An effect that passes both may
still be fitted to one sensor at the expense of another, or be so nearly the same as one adopted before that the two
pull against each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.calibration.joint_together import ABOUT
from magtensor.calibration.types import Array
from magtensor.loop.evidence.assessment import log_likelihood
from magtensor.loop.fitting.errors_before_after import calibrated_fields, folds_for, held_out
from magtensor.loop.fitting.model import Fitting, Record, State

WORST_RISE = 0.10  # of a sensor's |b| - F on held-out blocks; a dozen coefficients cost a hundred samples half of that
HARDLY_KNOWN = 3.0  # times the error of a fit to all: a block judges then what the others know of a calibration


@dataclass(frozen=True)
class BlockErrors:
    """Sums of the squares of |b| - F over the samples in use of F blocks, for each of S sensors.

    Attributes:
        sensors: names.
        samples: (F, S) how many are in use.
        held_out: (F, S) nT^2, each block calibrated with the others.
        within: (F, S) nT^2 with the fit to all.
    """

    sensors: tuple[str, ...]
    samples: NDArray[np.int_]
    held_out: Array
    within: Array

    @property
    def hardly_known(self) -> NDArray[np.bool_]:
        """(F, S) blocks of whose calibration the others know so little that they judge that and nothing else, as the
        one part of a flight that has its heading."""
        return self.held_out > HARDLY_KNOWN**2 * self.within

    def rms(self, blocks: NDArray[np.bool_] | None = None) -> dict[str, float]:
        """Held-out rms of each sensor, nT, over all blocks or those (F, S) given, which are all where there is none."""
        use = np.ones_like(self.samples) if blocks is None else blocks | ~blocks.any(axis=0)
        squares = (use * self.held_out).sum(axis=0) / np.maximum((use * self.samples).sum(axis=0), 1)
        return dict(zip(self.sensors, np.sqrt(squares).tolist(), strict=True))


@dataclass(frozen=True)
class Trial:
    """How a state stands.

    Attributes:
        state: of the fit.
        blocks: its errors; None where blocks alone do not determine a calibration.
        folds: the samples that each was judged on, as in `held_out`.
    """

    state: State
    blocks: BlockErrors | None
    folds: NDArray[np.int_]

    def hurt_by(self, after: Trial) -> list[str]:
        """Sensors whose error rises."""
        before, then = self.beside(after)
        return [s for s, e in then.items() if e > (1.0 + WORST_RISE) * before[s]]

    def helped_by(self, after: Trial) -> list[str]:
        """Sensors whose error falls."""
        before, then = self.beside(after)
        return [s for s, e in then.items() if e < before[s]]

    def beside(self, after: Trial) -> tuple[dict[str, float], dict[str, float]]:
        """Held-out rms of |b| - F of each sensor, nT, before and after, over the blocks that judge more than what the
        others know of a calibration; {} where blocks alone do not determine one."""
        if self.blocks is None or after.blocks is None:
            return {}, {}
        known = ~(self.blocks.hardly_known & after.blocks.hardly_known)
        return self.blocks.rms(known), after.blocks.rms(known)

    def likelier(self, after: Trial) -> bool:
        """Whether what another fit leaves is the likelier one, each in noise of its own colour."""
        return per_sample(after.state) > per_sample(self.state)


def trial(record: Record, state: State, how: Fitting) -> Trial:
    """Fit the state's models to some blocks and judge them on the others."""
    return _judged(record, state, how, state.fit.keep, folds_for(state))


def on_the_folds_of(after: Trial, record: Record, before: Trial, how: Fitting) -> Trial:
    """A trial on the folds of another one and the samples that one believes, if those are others or these are more.

    What happens once, or where a channel is at an end, may have been flagged before it had a name.
    """
    more = np.count_nonzero(after.state.fit.keep & ~before.state.fit.keep)
    if np.array_equal(before.folds, after.folds) and more <= ABOUT:
        return before
    return _judged(record, before.state, how, after.state.fit.keep, after.folds)


def _judged(record: Record, state: State, how: Fitting, keep: NDArray[np.bool_], folds: NDArray[np.int_]) -> Trial:
    found = held_out(record, state.adopted, how, state.theta, keep, folds)
    if found is None or found[1] is None:
        return Trial(state, None, folds)
    (apart, samples), (within, _) = (
        _squares(b, field, keep, folds) for b, field in (found, calibrated_fields(record, state, slice(None)))
    )
    return Trial(state, BlockErrors(record.sensors, samples, apart, within), folds)


def _squares(
    b: Array, total_field: Array | None, keep: NDArray[np.bool_], folds: NDArray[np.int_]
) -> tuple[Array, NDArray[np.int_]]:
    """(F, S) nT^2, the squares of |b| - F over the samples in use of each fold, and how many these are."""
    assert total_field is not None
    residual = np.linalg.norm(b, axis=2) - total_field[:, None]
    use = keep[:, None] & np.isfinite(residual)
    squares = np.where(use, residual, 0.0) ** 2
    return np.add.reduceat(squares, folds[:-1]), np.add.reduceat(use.astype(int), folds[:-1])


def per_sample(state: State) -> float:
    """Log likelihood of what a fit leaves, in noise of its own colour, for each sample that it believes."""
    return log_likelihood(state.residual, state.colours) / len(state.residual.affine)
