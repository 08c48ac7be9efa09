"""Whether a calibration is better without the samples of an event than with an error model of it.

A sensor whose axis is read with the wrong sign for a while, or that hangs loose, is off by thousands of nT, by another
law than any that a model of an event has. Most of it is explained, on held-out blocks too, and what is left of it in
these samples is still far above the noise and spoils the calibration of all others.
"""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Mask
from magtensor.errors import DataError
from magtensor.loop.fitting.model import Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.trial import WORST_RISE
from magtensor.loop.searching.contribution import moments

MOST = 0.3  # of the samples, in an event that can be left out
SEEN = 0.5  # of the noise of a sensor, from which on an effect acts
LEFT_BETWEEN = 0.25  # of the samples of an event: what is seen beside a passage lasts up to three times as long as it
LOUD = 2.0  # times what is left elsewhere


def between_its_flanks(state: State, which: int) -> bool:
    """Whether of the samples between the two times of an event more than a quarter have no part in the calibration:
    what has no law that is known lies between them, a passing source say, and the event is what is seen beside it."""
    when = moments(state.adopted[which])
    if len(when) != 2:
        return False
    elapsed = state.excitation.elapsed
    during = (elapsed >= when[0]) & (elapsed < when[1])
    return bool(during.any() and np.mean(~np.asarray(state.fit.keep)[during]) > LEFT_BETWEEN)


def better_left_out(record: Record, before: State, after: State, which: int, how: Fitting) -> bool:
    """Whether the other samples are fitted better by all more than a tenth without those in which an event acts, where
    it leaves more than twice as much in these.

    Parameters
    ----------
    before: the fit without the event; after, which: with it, and its number.
    """
    acting = while_it_acts(after, which)
    if not 0 < acting.mean() <= MOST or not left_of(after, acting) > LOUD * left_of(after, ~acting):
        return False
    try:
        kept = np.asarray(after.fit.keep) & ~acting
        without = joint_state(record, before.adopted, how, before.theta, keep=kept)
    except DataError:  # the other samples determine no calibration
        return False
    return left_of(after, ~acting) > (1.0 + WORST_RISE) * left_of(without, ~acting)


def while_it_acts(state: State, which: int) -> Mask:
    """(N,) samples in which an adopted model adds more than half the noise to any sensor, or those in which it does not
    where these are fewer, as before something lasting."""
    terms = state.adopted[which].terms(state.excitation)
    added = terms.contribution(state.theta[which], len(state.residual.noise)).reshape(len(state.excitation.time), -1, 3)
    acting: Mask = np.linalg.norm(added, axis=2).max(axis=1) > SEEN * state.residual.scale
    return acting if acting.mean() <= 0.5 else ~acting


def left_of(state: State, some: Mask) -> float:
    """nT rms of what a fit leaves in some of the samples (N,), in all sensors together."""
    residual = state.residual
    rows, square = some[residual.samples], 0.0
    if not rows.any():
        return 0.0
    if residual.across is not None:
        square += float(np.mean(np.sum((residual.across[rows] * residual.noise) ** 2, axis=1)))
    if residual.along is not None:
        square += float(np.mean((residual.along[rows] / residual.reference_gain[rows]) ** 2))
    return square**0.5
