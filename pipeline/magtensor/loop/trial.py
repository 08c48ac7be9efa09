"""The third gate: what an adoption does once everything is fitted anew, to every sensor, on blocks it has not seen.

The first two gates look at a residual as the fit leaves it, in noise of its own colour. An effect that passes both may
still be fitted to one sensor at the expense of another, or be so nearly the same as one adopted before that the two
pull against each other.
"""

from __future__ import annotations

from dataclasses import dataclass

from magtensor.loop.assessment import log_likelihood
from magtensor.loop.errors_before_after import held_out_error
from magtensor.loop.model import Fitting, Record, State

WORST_RISE = 0.10  # of a sensor's |b| - F on held-out blocks; a dozen coefficients cost a hundred samples half of that


@dataclass(frozen=True)
class Trial:
    """How a state stands.

    Attributes:
        state: of the fit.
        error: held-out rms of |b| - F of each sensor, nT; None where blocks alone do not determine a calibration.
    """

    state: State
    error: dict[str, float] | None

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
        return _per_sample(after.state) > _per_sample(self.state)


def trial(record: Record, state: State, how: Fitting) -> Trial:
    """Fit the state's models to some blocks and judge them on the others."""
    block = held_out_error(record, state.adopted, how, state.theta, state.fit.keep)
    figures = (block or {}).get("total_field_rms_nT")
    if figures is None or any(v is None for v in figures.values()):
        return Trial(state, None)
    return Trial(state, {s: float(figures[s]) for s in record.sensors})


def _per_sample(state: State) -> float:
    return log_likelihood(state.residual, state.colours) / len(state.residual.affine)
