"""Screening: every error model with every setting, quickly; then the most promising ones, closely."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import log
from typing import Any

import numpy as np

from magtensor.components import Component
from magtensor.error_models.settings import profiled
from magtensor.error_models.terms import Terms
from magtensor.loop.evidence.assessment import WHITE, Assessment, assess
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.evidence.scoring import Scorer
from magtensor.loop.fitting.log_noise import brought_in
from magtensor.loop.fitting.model import Adopted, State, generic
from magtensor.loop.fitting.separation import Assessed, lowest, plainer
from magtensor.loop.searching.contribution import happens_once
from magtensor.loop.searching.delayed_logs import Delays
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.kin import explained_beside, explained_by_kin
from magtensor.loop.searching.profiling import (
    REFINING_SAMPLES,
    SCREENING_SAMPLES,
    Thinned,
    best_settings,
    terms_of,
)
from magtensor.loop.searching.refining import refined
from magtensor.loop.searching.several_logs import of_another_log
from magtensor.sharing import shared_out

SCREENED = 8  # models looked at closely in each round
ALWAYS = 2  # of them, however little they explain
HOPELESS = 0.5  # corrected p value in the kinder of two colours of noise


def candidates_of(state: State, models: Sequence[Component], failed: dict[str, str], alpha: float) -> list[Candidate]:
    """The most promising models with their best settings, assessed; their p values corrected for all that was tried."""
    scored = _ranked(state, models, failed, alpha)
    names = {s.model.name for s in scored}
    if len(state.residual.affine) > REFINING_SAMPLES:
        scored = _scored_on_all(state, scored, failed)
    looked_at = _shortlist(scored, lambda s: s.white, len(names)) + _shortlist(scored, lambda s: s.coloured, len(names))
    looked_at += [s for s in scored if s.kind and s.promises(len(names))]
    assessed = _looked_at(state, looked_at, failed)
    found = _one_each(state, assessed)
    adjusted = _holm([a.p * tried for _, tried, _, a in found], len(names))
    own = _holm([a.own_p * tried for _, tried, _, a in found], len(names))
    null = _holm([a.null_p * tried for _, tried, _, a in found], len(names))
    candidates = [
        Candidate(
            model, tried, terms, assessment, p, own_p, null_p, alpha, _log_noise(state, model, terms, assessment),
            explained_beside(state, model, terms, assessment),
            explained_by_kin(state, model, terms, assessment),
        )
        for (model, tried, terms, assessment), p, own_p, null_p in zip(found, adjusted, own, null, strict=True)
    ]  # fmt: skip
    return sorted(candidates, key=lambda c: -c.assessment.gain.total)


def _ranked(state: State, models: Sequence[Component], failed: dict[str, str], alpha: float) -> list[_Screened]:
    """Every model with its best settings and what it explains, of a long survey on a part of the samples."""
    few, more = Thinned.of(state, SCREENING_SAMPLES), Thinned.of(state, REFINING_SAMPLES)
    delays = Delays(state.residual, state.excitation)

    def ranked(model: Component) -> tuple[list[tuple[dict[str, Any], float, float, float, str]], dict[str, str]]:
        rows, fails = [], dict[str, str]()
        for each in best_settings(model, state, few, delays, fails, alpha / max(len(models), 1)):
            terms = more.terms(model, each.settings, fails)
            if terms is not None and terms.count:
                white, coloured = (score(terms) - log(each.tried) for score in (more.white, more.coloured))
                rows.append((each.settings, each.tried, white, coloured, each.kind))
        return rows, fails

    scored = []
    for model, (rows, fails) in zip(models, shared_out(ranked, models), strict=True):
        scored += [_Screened(model, *row) for row in rows]
        failed.update(fails)
    return scored


def _scored_on_all(state: State, scored: Sequence[_Screened], failed: dict[str, str]) -> list[_Screened]:
    """Those that chance explains least, as they do on all samples."""
    residual = state.residual
    white, coloured = Scorer(residual, state.terms, WHITE), Scorer(residual, state.terms, state.colours)
    first = [sorted(scored, key=key, reverse=True)[:SCREENED] for key in (lambda s: s.white, lambda s: s.coloured)]

    def on_all(each: _Screened) -> tuple[float, float]:
        terms = terms_of(each.model, each.settings, state.excitation, failed)
        assert terms is not None
        terms = terms.at(residual.samples)
        return white(terms) - log(each.tried), coloured(terms) - log(each.tried)

    promising = [s for s in scored if any(s in some for some in first)]
    found = shared_out(on_all, promising)
    return [replace(each, white=w, coloured=c) for each, (w, c) in zip(promising, found, strict=True)]


def _looked_at(state: State, scored: Sequence[_Screened], failed: dict[str, str]) -> list[Assessed]:
    """Models with their settings refined, and in the plainer forms that they have, assessed on all samples."""
    residual = state.residual
    now = Whitened.of(residual, state.colours.across, state.colours.along, state.terms)
    noise = OwnNoise(residual, state.terms)

    def moved(each: _Screened) -> tuple[dict[str, Any], dict[str, str]]:
        fails: dict[str, str] = {}
        return refined(each.model, each.settings, state, fails), fails

    starts = list({(each.model.name, str(each.settings)): each for each in scored}.values())
    distinct: dict[tuple[str, str], _Screened] = {}
    for each, (settings, fails) in zip(starts, shared_out(moved, starts), strict=True):
        failed.update(fails)
        for one in (settings, *plainer(settings, profiled(each.model))):
            distinct.setdefault((each.model.name, str(one)), replace(each, settings=one))

    def assessed(each: _Screened) -> tuple[Terms, Assessment]:
        terms = terms_of(each.model, each.settings, state.excitation, failed)
        assert terms is not None
        terms = terms.at(residual.samples)
        return terms, assess(now, terms, once=happens_once(Adopted(each.model, each.settings)), noise=noise)

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
    """A model with settings, and how unlikely it is that chance explains as much in white noise and in noise of the
    residual's colour: -log of the p value, corrected for the settings that were tried; their kind, as in `Proposed`. Of
    a short part of the survey white noise says nothing."""

    model: Component
    settings: dict[str, Any]
    tried: float
    white: float
    coloured: float
    kind: str = ""

    def promises(self, models: int) -> bool:
        """Whether it may be significant among so many models when it is looked at closely."""
        least = self.coloured if self.kind == "short" else max(self.white, self.coloured)
        return bool(np.exp(-least) * models < HOPELESS)


def _shortlist(scored: Sequence[_Screened], score: Callable[[_Screened], float], models: int) -> list[_Screened]:
    """The models that chance explains least, each with the settings that do; of the hopeless ones hardly any."""
    best: dict[str, _Screened] = {}
    for each in (each for each in scored if not each.kind):
        if each.model.name not in best or score(each) > score(best[each.model.name]):
            best[each.model.name] = each
    first = sorted(best.values(), key=score, reverse=True)[: SCREENED // 2]
    return [each for rank, each in enumerate(first) if rank < ALWAYS // 2 or each.promises(models)]


def _one_each(state: State, assessed: Sequence[Assessed]) -> list[Assessed]:
    """Of a model assessed with several settings the one that predicts best, in the plainest form that does."""
    named: dict[str, list[Assessed]] = {}
    for each in assessed:
        named.setdefault(each[0].name, []).append(each)
    return [lowest(state, several, profiled(several[0][0].component)) for several in named.values()]


def _log_noise(state: State, model: Adopted, terms: Terms, assessment: Assessment) -> float:
    same = brought_in(state, model.channels(state.excitation)) if generic(model) else 0.0
    return max(same, of_another_log(state, model, terms, assessment.estimate))
