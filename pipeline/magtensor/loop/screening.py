"""Screening: every error model with every setting, quickly; then the most promising ones, closely."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.errors import UsageError
from magtensor.loop.assessment import (
    WHITE,
    Assessment,
    assess,
    colours_of,
    estimated,
    likeliest,
)
from magtensor.loop.evidence import Whitened
from magtensor.loop.excitation import Excitation
from magtensor.loop.log_noise import brought_in
from magtensor.loop.model import Adopted, State, regressors
from magtensor.loop.multiplicity import alike, effective_tests, projected
from magtensor.loop.residual import Residual, taken_off
from magtensor.loop.scoring import Scorer
from magtensor.loop.separation import SEPARATION, Assessed, lower_orders, lowest
from magtensor.loop.settings import EventTimes, Range
from magtensor.loop.terms import Terms, joined
from magtensor.sharing import shared_out

ALPHA = 0.005  # family-wise probability that a clean survey gets an adoption, before the second gate
ALONE = 1e-3  # probability that a single test by blocks is passed, which bears noise's own colour out
AMONG_ITS_SETTINGS = 0.05  # the same, that the test with the best of a model's settings is
UNLIKELY = 0.02  # of the family-wise probability: asked for in noise of the residual's own colour
SECOND_ORDER = 1e-5  # of the sum of squares that is explained: 0.3 % of an effect's size
LEAST_REDUCTION = 1e-4  # of the held-out sum of squares: smaller is significant only in very long surveys
LOG_MARGIN = 1.5  # the noise of a log is known to some per cent, and a dozen coefficients gain a little by chance
SCREENED = 8  # models looked at closely in each round
ALWAYS = 2  # of them, however little they explain
LEAST_RATIO = 2.0  # of the time constants, lags or widths of a model adopted twice
HOPELESS = 0.5  # corrected p value in the kinder of two colours of noise
SCREENING_SAMPLES = 2000  # settings are profiled on so many samples
REFINING_SAMPLES = 6000  # and the best of them refined on so many
MOST_OF_IT = 0.75  # of what a model explains, if it is to be made about other settings
_REFINEMENTS = 8


@dataclass(frozen=True)
class Candidate:
    """An error model with settings, looked at closely.

    Attributes:
        model: component and settings.
        tried: independent tests that the settings tried for it amount to, for the correction of its p value.
        terms: at the residual's samples.
        assessment: of the terms, given the models adopted before.
        adjusted_p: after the correction for settings and for the number of models.
        adjusted_null_p: the same for what it explains in noise of the residual's own colour.
        alpha: what the adjusted p has to stay below.
        log_noise: what noise in the log of its channel, brought in by a model adopted before, lets it gain.
        beside: sum of squares that the models adopted before explain.
    """

    model: Adopted
    tried: float
    terms: Terms
    assessment: Assessment
    adjusted_p: float
    adjusted_null_p: float
    alpha: float = ALPHA
    log_noise: float = 0.0
    beside: float = 0.0

    @property
    def of_the_log(self) -> bool:
        """Whether noise in the log of a channel explains what it gains."""
        return 0.0 < self.assessment.gain.total <= LOG_MARGIN * self.log_noise

    @property
    def of_second_order(self) -> bool:
        """Whether it is so small beside what is adopted that the next order of that explains as much.

        Every effect is described to first order, with logs that err: an attitude by a tenth of a degree is an error of
        0.2 % of a gradient.
        """
        return 0.0 < self.assessment.gain.total <= SECOND_ORDER * self.beside

    @property
    def significant(self) -> bool:
        """Whether noise does not explain it, all that was tried considered.

        By the scatter over blocks alone; or, because a dozen long blocks tell little of what is very unlikely, in noise
        of the colour that the residual has without the model, in which it then predicts held-out blocks as well, if the
        blocks bear it out as a test of this model alone.
        """
        if self.adjusted_p < self.alpha:
            return True
        unlikely = self.adjusted_null_p < UNLIKELY * self.alpha and self.assessment.null_gain.total > 0
        return unlikely and self.assessment.p < ALONE and self.assessment.p * self.tried < AMONG_ITS_SETTINGS

    @property
    def beyond_slow_noise(self) -> bool:
        """Whether noise of the colour that the residual has without the model, all of it taken for noise, does not
        explain what the model does: it predicts held-out blocks even so, or that much would be too unlikely.

        What happens once, at the beginning or end, is seen by few blocks, and the others cannot predict it closely
        enough in noise so strong.
        """
        return self.assessment.null_gain.total > 0 or self.adjusted_null_p < self.alpha

    @property
    def predicts(self) -> bool:
        """Whether it is significant and predicts held-out blocks, in noise of the colour of what it leaves."""
        if self.of_the_log or self.of_second_order:
            return False
        gain = self.assessment.gain
        reduction = gain.total / max(float(gain.before.sum()), 1e-300)
        return self.significant and (gain.consistent or self.predicts_where_it_acts) and reduction > LEAST_REDUCTION

    @property
    def predicts_where_it_acts(self) -> bool:
        """Whether a model that acts in a part of the survey only predicts one part of that from the others.

        Then the folds of equal length are but one or two figures, which may gain much and tell no scatter. The short
        folds in which it acts are not asked unless both the scatter over blocks and noise of the residual's own colour
        are out of the question, and in noise of that colour it has to predict them as well. Only of what follows a
        channel: a drift is everywhere, and short folds at its end say no more than that neighbours are alike.
        """
        from magtensor.loop.settings import AnyChannel

        if not any(isinstance(grid, AnyChannel) for grid in profiled(self.model.component).values()):
            return False
        focused, null = self.assessment.focused, self.assessment.null_focused
        if focused is None or null is None or self.assessment.gain.total <= 0:
            return False
        unlikely = self.adjusted_p < self.alpha and self.adjusted_null_p < UNLIKELY * self.alpha
        return unlikely and focused.consistent and null.total > 0

    @property
    def passes(self) -> bool:
        """Both gates."""
        return self.predicts and self.beyond_slow_noise


def repeatable(model: Component) -> bool:
    """A model that can be adopted more than once, with other settings.

    One that chooses a channel, time or line may act through several; a time constant, lag or width is seldom a single
    one, and what a second leaves is better called more of the same than something else.
    """
    from magtensor.loop.settings import AnyChannel, Frequencies

    grids = profiled(model).values()
    return any(isinstance(g, (AnyChannel, EventTimes, Frequencies)) or _of_ratios(g) for g in grids)


def _of_ratios(grid: Any) -> bool:
    """A setting whose values differ by factors: a time constant, lag or width."""
    return isinstance(grid, Range) and (grid.low >= 0 or grid.spacing == "log")


def profiled(model: Component) -> dict[str, Any]:
    """The settings of a model that are searched over, with their grids."""
    found = {}
    for name, parameter in model.parameters.items():
        for mark in getattr(parameter.annotation, "__metadata__", ()):
            if hasattr(mark, "values") and callable(mark.values):
                found[name] = mark
    return found


def settings_grid(model: Component, x: Excitation) -> list[dict[str, Any]]:
    """Every combination of the grids of a model's settings."""
    grids = {name: mark.values(x) for name, mark in profiled(model).items()}
    combinations: list[dict[str, Any]] = [{}]
    for name, values in grids.items():
        combinations = [{**c, name: v} for c in combinations for v in values]
    return combinations


def candidates_of(state: State, models: Sequence[Component], failed: dict[str, str], alpha: float) -> list[Candidate]:
    """The most promising models with their best settings, assessed; their p values corrected for all that was tried."""
    scored = _ranked(state, models, failed, alpha)
    names = {s.model.name for s in scored}
    if len(state.residual.affine) > REFINING_SAMPLES:
        scored = _scored_on_all(state, scored, failed)
    looked_at = _shortlist(scored, lambda s: s.white, len(names)) + _shortlist(scored, lambda s: s.coloured, len(names))
    assessed = _looked_at(state, looked_at, failed)
    found = _one_each(state, assessed)
    adjusted = _holm([a.p * tried for _, tried, _, a in found], len(names))
    null = _holm([a.null_p * tried for _, tried, _, a in found], len(names))
    beside = explained_before(state)
    candidates = [
        Candidate(model, tried, terms, assessment, p, null_p, alpha, _log_noise(state, model), beside)
        for (model, tried, terms, assessment), p, null_p in zip(found, adjusted, null, strict=True)
    ]
    return sorted(candidates, key=lambda c: -c.assessment.gain.total)


def _ranked(state: State, models: Sequence[Component], failed: dict[str, str], alpha: float) -> list[_Screened]:
    """Every model with its best settings and what it explains, of a long survey on a part of the samples."""
    few, more = _Thinned.of(state, SCREENING_SAMPLES), _Thinned.of(state, REFINING_SAMPLES)

    def ranked(model: Component) -> tuple[list[tuple[dict[str, Any], float, float, float]], dict[str, str]]:
        rows, fails = [], dict[str, str]()
        for settings, tried in _best_settings(model, state, few, fails, alpha / max(len(models), 1)):
            terms = more.terms(model, settings, fails)
            if terms is not None and terms.count:
                rows.append((settings, tried, more.white(terms), more.coloured(terms)))
        return rows, fails

    scored = []
    for model, (rows, fails) in zip(models, shared_out(ranked, models), strict=True):
        scored += [_Screened(model, *row) for row in rows]
        failed.update(fails)
    return scored


def _scored_on_all(state: State, scored: Sequence[_Screened], failed: dict[str, str]) -> list[_Screened]:
    """Those that explain most, as they do on all samples."""
    residual = state.residual
    white, coloured = Scorer(residual, state.terms, WHITE), Scorer(residual, state.terms, state.colours)
    first = [sorted(scored, key=key, reverse=True)[:SCREENED] for key in (lambda s: s.white, lambda s: s.coloured)]

    def on_all(each: _Screened) -> tuple[float, float]:
        terms = _terms(each.model, each.settings, state.excitation, failed)
        assert terms is not None
        terms = terms.at(residual.samples)
        return white(terms), coloured(terms)

    promising = [s for s in scored if any(s in some for some in first)]
    found = shared_out(on_all, promising)
    return [replace(each, white=w, coloured=c) for each, (w, c) in zip(promising, found, strict=True)]


def _looked_at(state: State, scored: Sequence[_Screened], failed: dict[str, str]) -> list[Assessed]:
    """Models with their settings refined, and with lower orders where they have such, assessed on all samples."""
    residual = state.residual
    now = Whitened.of(residual, state.colours.across, state.colours.along, state.terms)

    def refined(each: _Screened) -> tuple[dict[str, Any], dict[str, str]]:
        fails: dict[str, str] = {}
        return _refined(each.model, each.settings, state, fails), fails

    distinct: dict[tuple[str, str], _Screened] = {}
    for each, (settings, fails) in zip(scored, shared_out(refined, scored), strict=True):
        failed.update(fails)
        for one in (settings, *lower_orders(settings, profiled(each.model))):
            distinct.setdefault((each.model.name, str(one)), replace(each, settings=one))

    def assessed(each: _Screened) -> tuple[Terms, Assessment]:
        terms = _terms(each.model, each.settings, state.excitation, failed)
        assert terms is not None
        terms = terms.at(residual.samples)
        return terms, assess(now, terms)

    chosen = list(distinct.values())
    return [
        (Adopted(each.model, each.settings), each.tried, terms, assessment)
        for each, (terms, assessment) in zip(chosen, shared_out(assessed, chosen), strict=True)
    ]


def _holm(values: Sequence[float], models: int) -> list[float]:
    """P values corrected for the number of models; those not looked at closely count as less significant ones."""
    adjusted = [1.0] * len(values)
    running = 0.0
    for rank, i in enumerate(sorted(range(len(values)), key=lambda i: min(1.0, values[i]))):
        running = max(running, min(1.0, values[i] * max(models - rank, 1)))
        adjusted[i] = running
    return adjusted


@dataclass(frozen=True)
class _Screened:
    """A model with settings, and what it explains in white noise and in noise of the residual's colour."""

    model: Component
    settings: dict[str, Any]
    tried: float
    white: float
    coloured: float

    def promises(self, models: int) -> bool:
        """Whether it may be significant among so many models when it is looked at closely."""
        return bool(np.exp(-max(self.white, self.coloured)) * self.tried * models < HOPELESS)


@dataclass(frozen=True)
class _Thinned:
    """Some samples of a residual, on which settings are profiled, and how terms score there.

    Attributes:
        every, own: what models see of all samples, and of these.
        freedom: (n, 4) orthonormal, what the fit's own freedom follows.
        white, coloured: in white noise and in noise of the residual's own colour.
    """

    residual: Residual
    every: Excitation
    own: Excitation
    freedom: Array
    white: Scorer
    coloured: Scorer

    @classmethod
    def of(cls, state: State, most: int) -> _Thinned:
        residual, given = _thinned(state, most)
        colours = state.colours if residual is state.residual else colours_of(residual)
        x = state.excitation
        scorers = Scorer(residual, given, WHITE), Scorer(residual, given, colours)
        return cls(residual, x, x.at(residual.samples), np.linalg.qr(residual.affine)[0], *scorers)

    def terms(self, model: Component, settings: Mapping[str, Any], failed: dict[str, str]) -> Terms | None:
        """As `_terms`, at the samples."""
        if model.pointwise:
            return _terms(model, settings, self.own, failed)
        terms = _terms(model, settings, self.every, failed)
        return None if terms is None else terms.at(self.residual.samples)


def _best_settings(
    model: Component, state: State, few: _Thinned, failed: dict[str, str], alpha: float
) -> list[tuple[dict[str, Any], float]]:
    """The settings that explain most in white noise and in noise of the residual's own colour, if they differ.

    In white noise what is slow decides, in coloured noise what is fast. Beside each the number of independent tests
    that all settings amount to.
    """
    grid = [g for g in settings_grid(model, state.excitation) if not _already(state, model, g)]
    if len(grid) == 1:
        return [(grid[0], 1.0)]
    scores: list[tuple[float, float, dict[str, Any]]] = []
    chain: list[float] = []
    last: Array | None = None
    for settings in grid:
        terms = few.terms(model, settings, failed)
        if terms is None or not terms.count:
            continue
        scores.append((few.white(terms), few.coloured(terms), settings))
        series = projected(terms, few.freedom)
        if last is not None:
            chain.append(alike(last, series))
        last = series
    if not scores:
        return []
    tried = effective_tests(chain, alpha)
    best = max(scores, key=lambda s: s[0])[2], max(scores, key=lambda s: s[1])[2]
    return [(settings, tried) for settings in (best[:1] if best[0] is best[1] else best)]


def _shortlist(scored: Sequence[_Screened], score: Callable[[_Screened], float], models: int) -> list[_Screened]:
    """The models that explain most, each with the settings that do; of the hopeless ones hardly any."""
    best: dict[str, _Screened] = {}
    for each in scored:
        if each.model.name not in best or score(each) > score(best[each.model.name]):
            best[each.model.name] = each
    first = sorted(best.values(), key=score, reverse=True)[: SCREENED // 2]
    return [each for rank, each in enumerate(first) if rank < ALWAYS // 2 or each.promises(models)]


def _one_each(state: State, assessed: Sequence[Assessed]) -> list[Assessed]:
    """Of a model that was assessed with several settings, the one that predicts best, at the lowest order that does."""
    named: dict[str, list[Assessed]] = {}
    for each in assessed:
        named.setdefault(each[0].name, []).append(each)
    return [lowest(state, several, profiled(several[0][0].component)) for several in named.values()]


def explained_before(state: State) -> float:
    """Sum of squares of the whitened residual that the adopted models explain together."""
    if state.terms is None:
        return 0.0
    residual = state.residual
    back = taken_off(residual, state.terms, -np.concatenate(state.theta))
    return max(back.square() - residual.square(), 0.0) * len(residual.affine) * residual.freedom


def _log_noise(state: State, model: Adopted) -> float:
    return brought_in(state, model.settings) if generic(model) else 0.0


def generic(model: Adopted) -> bool:
    """A model of anything that follows a channel says less than one that names a cause."""
    return model.name in ("channel_response", "latent_source")


def _already(state: State, model: Component, settings: Mapping[str, Any]) -> bool:
    """Whether a model is in already with the same channel, and settings on ranges so near that the two could not be
    told apart."""
    from magtensor.loop.settings import AnyChannel

    grids = profiled(model)
    channels = {n for n, g in grids.items() if isinstance(g, AnyChannel)}
    ranges = {n for n, g in grids.items() if _of_ratios(g)}
    same = channels or set(grids) - ranges
    return any(
        all(adopted.settings.get(n) == settings.get(n) for n in same)
        and not any(_apart(adopted.settings[n], settings[n]) for n in ranges)
        for adopted in state.adopted
        if adopted.name == model.name
    )


def _apart(one: float, other: float) -> bool:
    return abs(one - other) > (LEAST_RATIO - 1.0) * min(abs(one), abs(other))


def _terms(model: Component, settings: Mapping[str, Any], x: Excitation, failed: dict[str, str]) -> Terms | None:
    """The model's regressors; None, and why, where it cannot make them or they are not finite."""
    try:
        terms = regressors(model, x, settings)
    except (KeyError, ValueError, UsageError) as error:
        failed[model.name] = str(error)
        return None
    if not np.isfinite(terms.series).all():
        failed[model.name] = "its regressors are not finite on this survey"
        return None
    return terms


def _refined(model: Component, settings: dict[str, Any], state: State, failed: dict[str, str]) -> dict[str, Any]:
    """Settings on a range, moved between the neighbours of the best grid value by golden section; a lag of none stays
    one where the data do not separate the two."""
    few = _thinned(state, REFINING_SAMPLES)
    for name, grid in profiled(model).items():
        if not isinstance(grid, (Range, EventTimes)):
            continue
        values = sorted(grid.values(state.excitation))
        place = int(np.argmin(np.abs(np.array(values) - settings[name])))
        low, high = values[max(place - 1, 0)], values[min(place + 1, len(values) - 1)]
        terms = _terms(model, settings, state.excitation, failed)
        if terms is None or high <= low:
            continue
        residual, given = few
        terms = terms.at(residual.samples)
        together = terms if given is None else joined([given, terms])
        score = Scorer(residual, given, likeliest(residual, together, [colours_of(residual), WHITE]).colours)

        def gain(value: float, name: str = name, score: Scorer = score, rest: dict[str, Any] = settings) -> float:
            found = _terms(model, {**rest, name: value}, state.excitation, failed)
            return -np.inf if found is None else score(found.at(few[0].samples))

        best = golden(gain, low, high, settings[name])
        if low <= 0.0 <= high and _of_ratios(grid) and gain(best) - gain(0.0) < SEPARATION / 2.0:
            best = 0.0
        settings = {**settings, name: best}
    return _about_what_it_fits(model, settings, state, failed) if model.about is not None else settings


def _about_what_it_fits(
    model: Component, settings: dict[str, Any], state: State, failed: dict[str, str]
) -> dict[str, Any]:
    """Settings about which a model is linear, moved to where its coefficients are, unless it explains far less there.

    In white noise: what is slow determines such coefficients, and the noise of the regressors themselves is fast. Of a
    delay, the lag that it is sought about hardly matters; if it matters, it is noise of the regressor.
    """
    residual, given = _thinned(state, REFINING_SAMPLES)
    score = Scorer(residual, given, WHITE)

    def at(settings: Mapping[str, Any]) -> Terms | None:
        terms = _terms(model, settings, state.excitation, failed)
        return None if terms is None else terms.at(residual.samples)

    first = terms = at(settings)
    assert model.about is not None
    moved = settings
    for _ in range(_REFINEMENTS):
        if terms is None:
            return settings
        together = terms if given is None else joined([given, terms])
        theta = estimated(residual, together, WHITE).theta[together.count - terms.count :]
        moved, before = dict(model.about(moved, theta)), moved
        if moved == before:
            break
        terms = at(moved)
    return moved if first is not None and terms is not None and score(terms) >= MOST_OF_IT * score(first) else settings


def _thinned(state: State, most: int) -> tuple[Residual, Terms | None]:
    """At most so many samples of a residual, evenly chosen, and the adopted terms there."""
    count = len(state.residual.affine)
    if count <= most:
        return state.residual, state.terms
    thin = np.arange(0, count, -(-count // most))
    return state.residual.smaller(thin), None if state.terms is None else state.terms.at(thin)


def golden(f: Callable[[float], float], low: float, high: float, best: float) -> float:
    """Where f is largest between two limits, by golden section; `best` if nothing exceeds f there."""
    ratio = (np.sqrt(5.0) - 1) / 2
    a, b = low, high
    c, d = b - ratio * (b - a), a + ratio * (b - a)
    fc, fd, known = f(c), f(d), f(best)
    for _ in range(_REFINEMENTS):
        if fc > fd:
            b, d, fd = d, c, fc
            c = b - ratio * (b - a)
            fc = f(c)
        else:
            a, c, fc = c, d, fd
            d = a + ratio * (b - a)
            fd = f(d)
    value, top = (c, fc) if fc > fd else (d, fd)
    return float(value) if top > known else best
