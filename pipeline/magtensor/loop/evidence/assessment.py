"""How strongly the data want a set of terms: coefficients, significance, held-out gain, in noise of its own colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from magtensor.calibration.types import Array
from magtensor.error_models.terms import Terms, joined
from magtensor.loop.evidence.colour import Colour, colour_of
from magtensor.loop.evidence.estimate import Estimate, own_information, solve
from magtensor.loop.evidence.folds import Blocks, known_until
from magtensor.loop.evidence.gains import Gain, focused_gain, held_out_gain
from magtensor.loop.evidence.grams import Grams, Whitened, grams, grams_in, normal
from magtensor.loop.evidence.lone_event import elsewhere, left_of
from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.evidence.residual import Residual, taken_off
from magtensor.loop.evidence.statistics import family_p
from magtensor.loop.evidence.turned import TurnedColour, excess_of, excess_of_one

NEARLY_ALL = 0.9  # of what is explained: the average colour of the sensors' noise then has to suit one of them
SLOWEST = 20  # part of the frequencies that count as slow
LEAST_SLOWEST = 30
BORNE_OUT = 0.05  # probability by blocks below which another noise is asked
_ROUNDS = 3  # the colour depends on the coefficients and they on it; after three nothing moves


@dataclass(frozen=True)
class Colours:
    """The colours of the two parts of a residual.

    Attributes:
        scale: nT, that a value of one in that residual stands for; None of noise that is white in any.
    """

    across: Colour
    along: Colour | TurnedColour
    scale: float | None = None

    def among(self, residual: Residual) -> Colours:
        """The same of a residual, which may have more samples or fewer, and be divided by other noise."""
        samples, along = len(residual.affine), self.along
        if isinstance(along, Colour):
            along = along.among(samples)
        elif len(along.modes.response) != samples:
            along = along.among(residual.slow_modes)
        louder = 1.0 if self.scale is None else (self.scale / residual.scale) ** 2
        return Colours(self.across.among(samples).louder(louder), along.louder(louder), residual.scale)


WHITE = Colours(Colour(None, 1.0), Colour(None, 1.0))


def colours_of(residual: Residual, *, stiff: bool = False, above: int = 1) -> Colours:
    """Fit both; `stiff` and, across, `above` as in `colour_of`."""
    white = Colour(None, 1.0)
    size = len(residual.noise)
    across = colour_of(residual.across, size - 3, stiff=stiff, above=above) if residual.across is not None else white
    along = white if residual.along is None else _along(residual, residual.along, across, stiff)
    return Colours(across, along, residual.scale)


def _along(residual: Residual, along: Array, across: Colour, stiff: bool) -> Colour | TurnedColour:
    """The colour along the field: the sensors' slow noise turned, as the contrasts show it, and a stationary rest."""
    plain = colour_of(along[:, None], stiff=stiff)
    modes = residual.slow_modes
    if residual.across is None:
        excess = excess_of_one(modes, along, plain.white) if plain.power is not None or stiff else np.zeros(0)
        share = 1.0
    else:
        excess, share = excess_of(across, modes.most), across.white / plain.white
    if not len(excess):
        return plain
    turned = TurnedColour(modes, np.repeat(excess * share, 3), Colour(None, 1.0))
    return replace(turned, rest=colour_of(turned.still(along)[:, None], stiff=stiff))


@dataclass(frozen=True)
class Assessment:
    """What the data say of terms.

    Attributes:
        estimate: coefficients, covariance (in noise of the fitted colour), information.
        parts: the blocks and folds that gains are asked on; of what happened once, where that is over soon, its parts.
        gain: on held-out blocks, in noise whose colour is found when the terms have explained their part.
        null_gain: the same in noise whose colour is found without them: what the null hypothesis says of the noise.
        focused, null_focused: both again on folds that know equally much of the terms, which are short where these act;
            None where a few blocks know nearly all.
        p: that all coefficients are zero, from the scatter over blocks; of what happens once, from noise of each
            sensor's own spectrum.
        own_p: of what happens once the same as p; of what lasts that from noise of each sensor's own spectrum, 1 where
            the blocks do not bear the test out.
        null_p: that from what they explain in noise of the colour that the residual has without them, stronger where it
            is all in one sensor with more slow noise than the others.
        left_there: part that they leave of what there was when something happened once and was over soon (`left_of`).
        colours: under the hypothesis that the terms are real.
        theta: the likeliest coefficients, with any colour: where a joint fit begins.
    """

    estimate: Estimate
    parts: Blocks
    gain: Gain
    null_gain: Gain
    focused: Gain | None
    null_focused: Gain | None
    p: float
    own_p: float
    null_p: float
    left_there: float
    colours: Colours
    theta: Array


def assess(
    now: Whitened, terms: Terms, *, once: bool = False, noise: OwnNoise | None = None, everywhere: bool = False
) -> Assessment:
    """Assess terms that no model holds yet, the coefficients of those that are in already being free as well.

    Two colours of noise are needed. A test of the null hypothesis uses the colour of the residual as it is: slow noise
    that a flexible model could follow must count as noise. How much the terms explain, and how well they compare with
    others, is asked in the colour of what they leave: seen in the first colour, a strong slow effect is itself noise.

    What happens once lies in two or three blocks, whose scatter tells nothing, and its time was sought in the data: any
    wandering, of a base station or of one bad sensor, has a place that looks like a step or a bump, by far too large
    for a law that is one for all. So it is judged in noise of each sensor's own spectrum (`own_noise`).

    Parameters
    ----------
    now: the residual of the current model with its terms, in noise of the residual's own colour.
    terms: with the residual's samples as rows.
    once: whether they are of something that happens once.
    noise: of the residual beside the given terms, where several terms are assessed in it.
    everywhere: as in `held_out_gain`.
    """
    residual, given = now.residual, now.given
    together = terms if given is None else joined([given, terms])
    first = together.count - terms.count
    blocked = np.arange(together.count) < first
    parts = Blocks.of_an_event(terms) if once else Blocks.equal(len(residual.affine))
    null = grams_in(now, terms, parts.edges)
    null_gain = held_out_gain(null, residual.freedom, blocked, parts, everywhere=everywhere)
    null_focused = focused_gain(null, residual.freedom, blocked, everywhere=everywhere)
    best = likeliest(residual, together, [Colours(now.across, now.along, residual.scale), WHITE], _estimate(null).theta)
    colours = best.colours
    sensor = _only_sensor(null, first, terms)
    stronger = slow_noise_of(sensor, taken_off(residual, together, best.theta), now.across)
    null_p = _p_of(null, first, max(stronger, 1.0))
    blocks = grams(residual, together, colours.across, colours.along, parts.edges)
    by_blocks = 0.0 if once else family_p(blocks, together.sensors, range(first, together.count))
    own_p = (noise or OwnNoise(residual, given)).p_value(terms) if by_blocks < BORNE_OUT else 1.0
    p = own_p if once else by_blocks
    gain = held_out_gain(blocks, residual.freedom, blocked, parts, everywhere=everywhere)
    focused = focused_gain(blocks, residual.freedom, blocked, everywhere=everywhere)
    left = left_there(residual, together, best.theta, first, parts)
    evidence = (parts, gain, null_gain, focused, null_focused, p, own_p, null_p, left)
    return Assessment(_estimate(blocks), *evidence, colours, best.theta)


def left_there(residual: Residual, terms: Terms, theta: Array, given: int, parts: Blocks) -> float:
    """What of something that is over soon is left at its time by all terms but the first `given` ones; 0 of what is
    not."""
    if parts.divided == (0, 0):
        return 0.0
    after = taken_off(residual, terms, theta)
    before = taken_off(residual, terms, np.where(np.arange(terms.count) < given, theta, 0.0))
    noise = colours_of(elsewhere(after, parts), stiff=True)
    known = known_until(terms.only(range(given, terms.count)))
    return left_of(before, after, known, noise.across, noise.along, parts)


@dataclass(frozen=True)
class Likeliest:
    """Coefficients (P,), the colour of what they leave, and the log likelihood of both."""

    theta: Array
    colours: Colours
    log_likelihood: float


def likeliest(residual: Residual, terms: Terms, guesses: Sequence[Colours], first: Array | None = None) -> Likeliest:
    """The likeliest coefficients and colour, found from first guesses of the colour.

    They depend on each other, and may agree in two ways: the terms explain what is slow, or the noise does and the
    terms follow its middle frequencies. Where one guess leads is not where another does, a law that fits the spectrum
    badly may lead away from both, and the likelihood says which to believe.

    Parameters
    ----------
    first: (P,) coefficients in noise of the first guess, where they are known.
    """
    found: list[Likeliest] = []
    begun: list[Colours] = []
    for colours in guesses:
        for _ in range(_ROUNDS):
            if any(_alike(colours, before) for before in begun):
                break  # where this leads is known
            begun.append(colours)
            theta = first if first is not None and len(begun) == 1 else estimated(residual, terms, colours).theta
            left = taken_off(residual, terms, theta)
            colours = colours_of(left, stiff=True)
            found.append(Likeliest(theta, colours, log_likelihood(left, colours)))
    return max(found, key=lambda each: each.log_likelihood)


def _p_of(blocks: Grams, given: int, variance: float) -> float:
    """P value of all terms but the first ones, from what they explain in white noise of a variance."""
    from scipy.special import chdtrc

    n, y = normal(blocks.total())
    own = own_information(blocks)
    every, without = solve(n[0], y[0], own), solve(n[0, :given, :given], y[0, :given], own.of(slice(given)))
    gained = max(explained(every) - explained(without), 0.0) / variance
    return float(chdtrc(max(every.rank - without.rank, 1), gained))


def _only_sensor(blocks: Grams, given: int, terms: Terms) -> int | None:
    """The number of the sensor whose coefficients hold nearly all that terms beside the given ones explain."""
    n, y = normal(blocks.total())
    theta, own = solve(n[0], y[0], own_information(blocks)).theta[given:], n[0, given:, given:]
    held: dict[int, float] = {}
    for sensor in set(terms.part_output // 3):
        each = sorted(set(terms.part_term[terms.part_output // 3 == sensor]))
        held[int(sensor)] = float(theta[each] @ own[np.ix_(each, each)] @ theta[each])
    most = max(held, key=lambda s: held[s])
    return most if "" not in terms.sensors and held[most] > NEARLY_ALL * sum(held.values()) else None


def slow_noise_of(sensor: int | None, left: Residual, across: Colour) -> float:
    """Power of the slow noise that one sensor is left with, over that of all on average; 1 for none or the only one."""
    if left.across is None or sensor is None:
        return 1.0
    from scipy.fft import dct

    slow = max(len(left.across) // SLOWEST, LEAST_SLOWEST)
    spectrum = dct(left.across, axis=0, norm="ortho")[1:slow]
    if across.power is not None:
        spectrum /= np.sqrt(across.power[1:slow, None])
    power = np.mean(spectrum**2, axis=0).reshape(-1, 3).mean(axis=1)
    return float(power[sensor] / power.mean())


def log_likelihood(residual: Residual, colours: Colours) -> float:
    """Of a residual in noise of given colours, but for a constant."""
    total, size = 0.0, len(residual.noise)
    total += 2.0 * len(residual.affine) * residual.freedom * float(np.mean(np.log(residual.noise)))
    if residual.across is not None:
        total += (size - 3) * colours.across.log_volume(len(residual.affine))
        total += float(np.sum(colours.across.whiten(residual.across, back=False) ** 2))
    if residual.along is not None:
        total += colours.along.log_volume(len(residual.affine))
        total += float(np.sum(colours.along.whiten(residual.along, back=False) ** 2))
    if residual.sighted is not None:
        total += float(np.sum(residual.sighted.residual**2))
    return -total / 2.0


def estimated(residual: Residual, terms: Terms, colours: Colours) -> Estimate:
    """Coefficients in noise of given colours."""
    return estimated_in(Whitened.of(residual, colours.across, colours.along, over_time=False), terms)


def estimated_in(white: Whitened, terms: Terms | None) -> Estimate:
    """The same of the terms that are in a whitened residual already, and of more where there are any."""
    return _estimate(grams_in(white, terms))


def _estimate(blocks: Grams) -> Estimate:
    n, y = normal(blocks.total())
    return solve(n[0], y[0], own_information(blocks))


def explained(estimate: Estimate) -> float:
    """Reduction of the sum of squares in the sample, in noise of unit variance."""
    out: float = float(estimate.theta @ estimate.normal @ estimate.theta)
    return out


def _alike(a: Colours, b: Colours) -> bool:
    return all(
        np.isclose(x.white, y.white, rtol=1e-3) and 1 / 1.1 < x.lowest / y.lowest < 1.1
        for x, y in ((a.across, b.across), (a.along, b.along))
    )
