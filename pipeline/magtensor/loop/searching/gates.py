"""The first two gates: what an error model has to show before anything is fitted anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.error_models.needs import FACTS
from magtensor.error_models.settings import AnyChannel, profiled
from magtensor.error_models.terms import Terms, joined
from magtensor.loop.evidence.assessment import BORNE_OUT, Assessment
from magtensor.loop.evidence.lone_event import MOST_LEFT
from magtensor.loop.evidence.residual import Residual, taken_off
from magtensor.loop.evidence.statistics import by_long_blocks
from magtensor.loop.fitting.model import Adopted, State, of_time, turning
from magtensor.loop.fitting.separation import SECOND_ORDER
from magtensor.loop.searching.contribution import a_tone, happens_once

ALPHA = 0.005  # family-wise probability that a clean survey gets an adoption, before the second gate
OF_THE_LAW = 0.0025  # the same, that the law of an effect may miss: 5 % of its size
LEAST_REDUCTION = 1e-4  # of the held-out sum of squares: smaller is significant only in very long surveys
FAR_MORE = 5.0  # times what is explained: two effects of one trend, which help each other, come to twice it
UNEVENLY = 1.0  # paired t: one standard deviation; what predicts nothing has as much one time in six
MUCH = 0.1  # of the held-out sum of squares: no noise of a clean survey is predicted so well
LOG_MARGIN = 1.5  # the noise of a log is known to some per cent
LOG_DEVIATIONS = 3.0  # of what coefficients gain of it by chance


@dataclass(frozen=True)
class Candidate:
    """An error model with settings, looked at closely.

    Attributes:
        model: component and settings.
        tried: independent tests that the settings tried for it amount to, for the correction of its p value.
        terms: at the residual's samples.
        assessment: of the terms, given the models adopted before.
        adjusted_p: after the correction for settings and for the number of models.
        adjusted_own_p: the same in noise of each sensor's own spectrum.
        adjusted_null_p: the same for what it explains in noise of the residual's own colour.
        alpha: what the adjusted p has to stay below.
        log_noise: what noise in the log of its channel, brought in by a model adopted before, lets it gain.
        beside: sum of squares that the models adopted before explain to first order; kin: the same of those that have
            its sensors and what drives it (`kin`).
        before: what it was judged against, where that is the fit with it, its part put back (`own_fit`).
        moved: the place of an adopted model that takes other settings beside it, and that model with these (`split`);
            `terms` are of both then, the one that takes other settings first.
        of_an_event: whether something that happened once, which passes, is a part of what it explains with a channel.
    """

    model: Adopted
    tried: float
    terms: Terms
    assessment: Assessment
    adjusted_p: float
    adjusted_own_p: float
    adjusted_null_p: float
    alpha: float = ALPHA
    log_noise: float = 0.0
    beside: float = 0.0
    kin: float = 0.0
    before: State | None = None
    moved: tuple[int, Adopted] | None = None
    of_an_event: bool = False

    def among(self, models: int) -> Candidate:
        """The same, found among so many models rather than by itself."""
        each = self.adjusted_p, self.adjusted_own_p, self.adjusted_null_p
        p, own_p, null_p = (min(1.0, value * max(models, 1)) for value in each)
        return replace(self, adjusted_p=p, adjusted_own_p=own_p, adjusted_null_p=null_p)

    @property
    def of_the_log(self) -> bool:
        """Whether noise in the log of a channel explains what it gains."""
        return 0.0 < self.assessment.gain.total <= gained_of_a_log(self.log_noise, self.assessment.estimate.rank)

    @property
    def of_second_order(self) -> bool:
        """Whether it is so small beside what is adopted that the next order of that explains as much.

        Every effect is described to first order, with logs that err: an attitude by a tenth of a degree is an error of
        0.2 % of a gradient.
        """
        return 0.0 < self.assessment.gain.total <= SECOND_ORDER * self.beside

    @property
    def of_the_law(self) -> bool:
        """Whether it is no more than the law of an adopted effect, which has its driver and its sensors, may miss."""
        return 0.0 < self.assessment.gain.total <= OF_THE_LAW * self.kin

    @property
    def of_no_shape(self) -> bool:
        """Whether it leaves too much of what there was when it happened."""
        return self.assessment.left_there > MOST_LEFT

    @property
    def of_no_blocks(self) -> bool:
        """Whether it predicts far more than it explains: what is adopted cannot be known from the other blocks, and
        errs by so much without it on those that are held out. Not of what follows the turning: a delay that all
        sensors share is hardly known from any blocks, and takes up all that shortens the field."""
        if turning(self.model.component):
            return False
        estimate = self.assessment.estimate
        explained = estimate.explained_beside(len(estimate.theta) - self.terms.count)
        return 0.0 < FAR_MORE * explained < self.assessment.gain.total

    @property
    def significant(self) -> bool:
        """Whether noise does not explain it, all that was tried considered.

        By its p value alone, if it is from long blocks too or nothing slow can be the cause. Or, because a dozen long
        blocks tell little of what is very unlikely, in noise of each sensor's own spectrum, if the blocks bear it out:
        as a test of this model alone where it is added to the axes,
        among all models where it turns with the field, for noise that turns with it (a mount that creeps) has no
        spectrum. The p value of what happens once is not from blocks, and of a tone that spectrum does not know that
        its strongest line was taken. Nor do blocks tell much of what switched once or twice: an event that noise does
        not explain, and that is a part of it, says that there is something.
        """
        if self.of_an_event or (self.adjusted_p < self.alpha and not self._of_slow_noise_that_turns):
            return True
        if not self._of_a_known_spectrum:
            return False
        by_blocks = self.assessment.p * self.tried if self.terms.adds_to_axes else self.adjusted_p
        return self.adjusted_own_p < self.alpha and by_blocks < BORNE_OUT

    @property
    def _of_slow_noise_that_turns(self) -> bool:
        """Whether slow noise of the sensors may be taken for it: it turns with the field, which makes its squares and
        products with what it turns slow, so many coefficients that only short blocks are asked of them, and noise
        explains as much in the residual's own colour and in each sensor's own spectrum."""
        turns = not self.terms.adds_to_axes or _of_the_field(self.model.component)
        if not turns or happens_once(self.model) or by_long_blocks(self.terms.sensors):
            return False
        return min(self.adjusted_null_p, self.adjusted_own_p) >= self.alpha

    @property
    def _of_a_known_spectrum(self) -> bool:
        """Whether noise of each sensor's own spectrum is a test of it by itself: not of what was sought where that
        noise is strongest, or of an event, whose time was."""
        return not happens_once(self.model) and not a_tone(self.model)

    @property
    def beyond_own_noise(self) -> bool:
        """Whether it is added to the axes and noise of each sensor's own spectrum does not explain it."""
        return self._of_a_known_spectrum and self.terms.adds_to_axes and self.adjusted_own_p < self.alpha

    @property
    def beyond_slow_noise(self) -> bool:
        """Whether noise of the colour that the residual has without the model, all of it taken for noise, does not
        explain what the model does: it predicts held-out blocks even so, or that much would be too unlikely, in noise
        of that colour or of each sensor's own spectrum.

        What happens once, at the beginning or end, is seen by few blocks, and the others cannot predict it closely
        enough in noise so strong.
        """
        unlikely = self.adjusted_null_p < self.alpha or self.beyond_own_noise
        return self.assessment.null_gain.total > 0 or unlikely

    @property
    def predicts(self) -> bool:
        """Whether it is significant and predicts held-out blocks, in noise of the colour of what it leaves."""
        if not self._more_than_known or not self.significant:
            return False
        return self.assessment.gain.consistent or self.predicts_where_it_acts

    @property
    def may_be_hindered(self) -> bool:
        """Whether it may fail because another effect that has no name yet moves some blocks: it is significant, and
        predicts some of them far better than others; or it is not, but predicts much."""
        gain = self.assessment.gain
        if not self._more_than_known:
            return False
        if self.significant:
            return not self.predicts and gain.t > UNEVENLY and self.beyond_slow_noise
        return gain.consistent and gain.total > MUCH * float(gain.before.sum())

    @property
    def unlike_its_law(self) -> bool:
        """Whether noise does not explain it and yet it does not predict: the law may be another one, as where what
        follows a channel has an end to it, and acts in a part of the survey only."""
        return self._more_than_known and not self.passes and self.beyond_own_noise

    @property
    def _more_than_known(self) -> bool:
        """Whether neither what is adopted nor the log's noise explains it, and it is large enough to matter."""
        if self.of_the_log or self.of_second_order or self.of_the_law or self.of_no_shape or self.of_no_blocks:
            return False
        gain = self.assessment.gain
        return gain.total / max(float(gain.before.sum()), 1e-300) > LEAST_REDUCTION

    @property
    def predicts_where_it_acts(self) -> bool:
        """Whether a model that acts in a part of the survey only predicts one part of that from the others.

        Then the folds of equal length are but one or two figures, which may gain much and tell no scatter. The short
        folds in which it acts are not asked unless noise as slow and as strong as the residual's own does not explain
        it, and in noise of the residual's own colour it has to predict them as well. By its p value and that in noise
        of that colour this is known of what happens once or follows a channel: a drift is everywhere, and short folds
        at its end say no more than that neighbours are alike. In noise of each sensor's own spectrum it is known of a
        drift too.
        """
        focused, null = self.assessment.focused, self.assessment.null_focused
        if focused is None or null is None or self.assessment.gain.total <= 0:
            return False
        channel = any(isinstance(grid, AnyChannel) for grid in profiled(self.model.component).values())
        by_blocks = self.adjusted_p < self.alpha or self.of_an_event
        unlikely = by_blocks and self.adjusted_null_p < self.alpha
        if not (unlikely and (channel or happens_once(self.model))) and not self.beyond_own_noise:
            return False
        return focused.consistent and not focused.contradicted and null.total > 0

    @property
    def passes(self) -> bool:
        """Both gates."""
        return self.predicts and self.beyond_slow_noise


def _of_the_field(component: Component) -> bool:
    """Whether an effect follows the field that turns, and neither a channel nor time."""
    channel = any(isinstance(grid, AnyChannel) for grid in profiled(component).values())
    known = all(need in FACTS for need in component.declared({}).needs)
    return known and not channel and not of_time(component)


def gained_of_a_log(log_noise: float, coefficients: float) -> float:
    """The most that coefficients gain of noise in the log of a channel, whose sum of squares is given; 0 of none.

    Beside the noise of the sensors that is a chi-square with so many degrees of freedom whose noncentrality is the sum.
    """
    if log_noise <= 0:
        return 0.0
    scatter = LOG_DEVIATIONS * float(np.sqrt(2.0 * coefficients + 4.0 * log_noise))
    return max(LOG_MARGIN * log_noise, log_noise + coefficients + scatter)


def explained_before(state: State, *, between: bool = False) -> float:
    """Sum of squares of the whitened residual that the adopted models explain together to first order.

    Delays, which are taken off to all orders, have no part in it; nor has the reference, where what is beside it is
    seen `between` the sensors: they share one.
    """
    acting = [i for i, a in enumerate(state.adopted) if not (between and a.component.effect == "reference")]
    return explained_by(state, acting)


def seen_between(residual: Residual, terms: Terms, theta: Array) -> bool:
    """Whether most of what terms with coefficients (P,) do differs between the sensors."""
    if residual.across is None or residual.along is None:
        return residual.along is None
    none = replace(residual, across=np.zeros_like(residual.across), along=np.zeros_like(residual.along), sighted=None)
    done = taken_off(none, terms, theta)
    assert done.across is not None and done.along is not None
    return float(np.sum(done.across**2)) > float(np.sum(done.along**2))


def explained_by(state: State, places: Sequence[int]) -> float:
    """The same of some of the adopted models."""
    residual = state.residual
    first_order = [
        (terms.at(residual.samples), state.theta[place])
        for place in places
        if (terms := state.adopted[place].terms(state.excitation)).delay is None
    ]
    if not first_order:
        return 0.0
    back = taken_off(
        residual, joined([terms for terms, _ in first_order]), -np.concatenate([t for _, t in first_order])
    )
    return max(back.square() - residual.square(), 0.0) * len(residual.affine) * residual.freedom
