"""The third gate: what an adoption does once everything is fitted anew, to every sensor, on blocks it has not seen.

The first two gates look at a residual as the fit leaves it, in noise of its own colour. An effect that passes both may
still be fitted to one sensor at the expense of another, or be so nearly the same as one adopted before that the two
pull against each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtensor.loop.evidence.assessment import log_likelihood
from magtensor.loop.fitting.errors_before_after import folds_for, held_out_error
from magtensor.loop.fitting.model import Fitting, Record, State

WORST_RISE = 0.10  # of a sensor's |b| - F on held-out blocks; a dozen coefficients cost a hundred samples half of that


@dataclass(frozen=True)
class Trial:
    """How a state stands.

    Attributes:
        state: of the fit.
        error: held-out rms of |b| - F of each sensor, nT; None where blocks alone do not determine a calibration.
        folds: the samples that each was judged on, as in `held_out_error`.
    """

    state: State
    error: dict[str, float] | None
    folds: NDArray[np.int_]

    def hurt_by(self, after: Trial) -> list[str]:
        """Sensors whose error rises."""
        if self.error is None or after.error is None:
            return []
        return [s for s, e in after.error.items() if e > (1.0 + WORST_RISE) * self.error[s]]

    def helped_by(self, after: Trial) -> list[str]:
        """Sensors whose error falls."""
        if self.error is None or after.error is None:
            return []
        return [s for s, e in after.error.items() if e < self.error[s]]

    def likelier(self, after: Trial) -> bool:
        """Whether what another fit leaves is the likelier one, each in noise of its own colour."""
        return per_sample(after.state) > per_sample(self.state)


def trial(record: Record, state: State, how: Fitting) -> Trial:
    """Fit the state's models to some blocks and judge them on the others."""
    return _judged(record, state, how, state.fit.keep, folds_for(state))


def on_the_folds_of(after: Trial, record: Record, before: Trial, how: Fitting) -> Trial:
    """A trial on the folds of another one, if they are others; then on the samples that one believes, too.

    What happens once may have been flagged before it had a name.
    """
    if np.array_equal(before.folds, after.folds):
        return before
    return _judged(record, before.state, how, after.state.fit.keep, after.folds)


def _judged(record: Record, state: State, how: Fitting, keep: NDArray[np.bool_], folds: NDArray[np.int_]) -> Trial:
    block = held_out_error(record, state.adopted, how, state.theta, keep, folds)
    figures = (block or {}).get("total_field_rms_nT")
    if figures is None or any(v is None for v in figures.values()):
        return Trial(state, None, folds)
    return Trial(state, {s: float(figures[s]) for s in record.sensors}, folds)


def per_sample(state: State) -> float:
    """Log likelihood of what a fit leaves, in noise of its own colour, for each sample that it believes."""
    return log_likelihood(state.residual, state.colours) / len(state.residual.affine)
