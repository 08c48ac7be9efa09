"""How strongly the data want a set of terms: coefficients, significance, held-out gain, in noise of its own colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.colour import Colour, colour_of
from magtensor.loop.evidence import grams, normal
from magtensor.loop.residual import Residual, taken_off
from magtensor.loop.statistics import Estimate, Gain, family_p, held_out_gain, own_information, solve
from magtensor.loop.terms import Terms, joined

FINEST_BLOCKS = 120
LEAST_PER_BLOCK = 4
_ROUNDS = 3  # the colour depends on the coefficients and they on it; after three nothing moves


@dataclass(frozen=True)
class Colours:
    """The colours of the two parts of a residual."""

    across: Colour
    along: Colour


def colours_of(residual: Residual, *, stiff: bool = False) -> Colours:
    """Fit both; `stiff` as in `colour_of`."""
    white = Colour(None, 1.0)
    size = len(residual.noise)
    across = colour_of(residual.across, size - 3, stiff=stiff) if residual.across is not None else white
    along = colour_of(residual.along[:, None], stiff=stiff) if residual.along is not None else white
    return Colours(across, along)


@dataclass(frozen=True)
class Assessment:
    """What the data say of terms.

    Attributes:
        estimate: coefficients, covariance (in noise of the fitted colour), information.
        gain: on held-out blocks, in noise whose colour is found when the terms have explained their part.
        null_gain: the same in noise whose colour is found without them: what the null hypothesis says of the noise.
        p: that all coefficients are zero, in noise of the null hypothesis' colour.
        colours: under the hypothesis that the terms are real.
    """

    estimate: Estimate
    gain: Gain
    null_gain: Gain
    p: float
    colours: Colours


def block_count(samples: int) -> int:
    """Blocks for a survey of so many samples."""
    return int(np.clip(samples // LEAST_PER_BLOCK, 1, FINEST_BLOCKS))


def assess(residual: Residual, terms: Terms, colours: Colours, given: Terms | None = None) -> Assessment:
    """Assess terms that no model holds yet, the coefficients of the given ones being free as well.

    Two colours of noise are needed. A test of the null hypothesis uses the colour of the residual as it is: slow noise
    that a flexible model could follow must count as noise. How much the terms explain, and how well they compare with
    others, is asked in the colour of what they leave: seen in the first colour, a strong slow effect is itself noise.

    Parameters
    ----------
    residual: of the current model.
    terms: with the residual's samples as rows.
    colours: of the residual.
    given: terms of the current model, whose coefficients are fitted along.
    """
    together = terms if given is None else joined([given, terms])
    first = together.count - terms.count
    own = list(range(first, together.count))
    blocked = np.arange(together.count) < first
    count = block_count(len(residual.affine))
    null = grams(residual, together, colours.across, colours.along, count)
    null_gain = held_out_gain(null, residual.freedom, blocked)
    now = colours
    for _ in range(_ROUNDS):
        estimate = estimated(residual, together, now)
        after = colours_of(taken_off(residual, together, estimate.theta), stiff=True)
        settled = _alike(after, now)
        now = after
        if settled:
            break
    blocks = grams(residual, together, now.across, now.along, count)
    n, y = normal(blocks.total())
    estimate = solve(n[0], y[0], own_information(blocks))
    p = family_p(blocks, together.sensors, own)
    return Assessment(estimate, held_out_gain(blocks, residual.freedom, blocked), null_gain, p, now)


def estimated(residual: Residual, terms: Terms, colours: Colours) -> Estimate:
    """Coefficients in noise of given colours."""
    whole = grams(residual, terms, colours.across, colours.along)
    n, y = normal(whole)
    return solve(n[0], y[0], own_information(whole))


def explained(estimate: Estimate) -> float:
    """Reduction of the sum of squares in the sample, in noise of unit variance."""
    out: float = float(estimate.theta @ estimate.normal @ estimate.theta)
    return out


def _alike(a: Colours, b: Colours) -> bool:
    return all(
        np.isclose(x.white, y.white, rtol=1e-3) and _lowest(x) < 1.1 * _lowest(y) and _lowest(y) < 1.1 * _lowest(x)
        for x, y in ((a.across, b.across), (a.along, b.along))
    )


def _lowest(colour: Colour) -> float:
    return 1.0 if colour.power is None else float(colour.power[0])


def contribution_rms(terms: Terms, theta: Array, outputs: int) -> Array:
    """(outputs,) nT rms that terms add to each raw output, their mean taken off (an offset would hold it)."""
    out: Array = terms.contribution(theta, outputs).std(axis=0)
    return out
