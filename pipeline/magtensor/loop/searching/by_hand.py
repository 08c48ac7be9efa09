"""What becomes of a fit when a person adopts or rejects a model, and what the loop computes of it."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from magtensor.components import Component
from magtensor.error_models.settings import AnyChannel, profiled
from magtensor.errors import DataError, NotEnoughData, UsageError, did_you_mean
from magtensor.loop.evidence.assessment import estimated
from magtensor.loop.fitting.model import Fitting, Record, State
from magtensor.loop.fitting.trial import on_the_folds_of, trial
from magtensor.loop.searching.adopting import adopt
from magtensor.loop.searching.contribution import removal, without_models
from magtensor.loop.searching.found import Step
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.latent import NAME, renewed, sought, tried_source
from magtensor.loop.searching.outcome import why
from magtensor.loop.searching.rivals import simplest
from magtensor.loop.searching.screening import candidates_of

ADOPTED = "{} is adopted already; reject it or undo first to adopt it otherwise"


@dataclass(frozen=True)
class ByHand:
    """A fit after a decision by hand.

    Attributes:
        told: what the loop computed of the decision, in words.
        record: the samples, with the waveform of an adopted source that nobody logged.
        state: the fit with all that is adopted now.
        step: the round that an adoption makes; None where something was taken out.
    """

    told: str
    record: Record
    state: State
    step: Step | None


def adopted(record: Record, state: State, chosen: Candidate, ranking: Sequence[Candidate], how: Fitting) -> ByHand:
    """The fit with a model, whatever the gates say.

    Parameters
    ----------
    chosen: the model, with its best settings.
    ranking: the models that are open.

    Raises
    ------
    DataError: the model has nothing of its own on this survey.
    """
    part = _new_directions(chosen, state)
    after = trial(record, adopt(record, state, chosen, how), how)
    standing = on_the_folds_of(after, record, trial(record, state, how), how)
    record, refitted = renewed(record, after.state, how)
    name = chosen.model.name
    first, others = simplest(chosen, [c for c in ranking if c.predicts and c.model.name != name], state)
    rivals = tuple(sorted({first.model.name, *others} - {name}))
    words = [judged(chosen), *([part] if part else [])]
    if hurt := standing.hurt_by(after):
        words.append(f"fitted, it raises the held-out error of {', '.join(hurt)}")
    if not standing.likelier(after):
        words.append("fitted together with the others, it leaves more than it takes away")
    step = Step(state, tuple(ranking) if chosen in ranking else (chosen,), chosen, rivals)
    return ByHand("; ".join(words), record, refitted, step)


def source_adopted(record: Record, state: State, component: Component, how: Fitting) -> ByHand:
    """The fit with a source that nobody logged taken off.

    Raises
    ------
    NotEnoughData, DataError: the survey shows none.
    """
    shared = sought(state, record)
    if shared is None:
        raise NotEnoughData("the survey has too few sensors or samples to show a source that nobody logged")
    shared, source = tried_source(component, record, state, shared, how, 1.0)
    if source is None:
        why_not = shared.objection or f"noise of the sensors alone explains it (p {shared.p:.2g})"
        raise DataError(f"no source that nobody logged can be taken off: {why_not}")
    told = f"p {shared.p:.2g}, held-out gain {shared.gain.total:.4g} (t {shared.gain.t:.2g})"
    return ByHand(told, source.record, source.after, Step(state, (), source.evidence, like=source.like))


def taken_out(record: Record, state: State, places: Sequence[int], how: Fitting) -> ByHand:
    """The fit without some of its adopted models."""
    parts = []
    for i in places:
        worse, better = removal(state, i)
        parts.append(f"held-out residual {better:.4g} nT with it, {worse:.4g} nT without")
    if NAME in {state.adopted[i].name for i in places}:
        record = replace(record, waveform=None)
    record, left = renewed(record, without_models(record, state, places, how), how)
    return ByHand(f"taken out again: {'; '.join(parts)}", record, left, None)


def candidate(component: Component, given: Mapping[str, Any], state: State, models: int, alpha: float) -> Candidate:
    """A model with its best settings, those given held.

    Parameters
    ----------
    state: with the spectral lines of all samples.
    models: that are open, for the correction of p.

    Raises
    ------
    UsageError: it is adopted already with these settings, or follows the channel of one that is.
    DataError: the survey cannot have it.
    """
    channels = [n for n, g in profiled(component).items() if isinstance(g, AnyChannel) and n in given]
    for one in state.adopted:
        if one.name == component.name and given.items() <= one.settings.items():
            raise UsageError(f"{component.name} is adopted already with these settings")
        if one.name == component.name and any(one.settings.get(c) == given.get(c) for c in channels):
            raise UsageError(ADOPTED.format(component.name))
    failed: dict[str, str] = {}
    found = candidates_of(state, [pinned(component, given)], failed, alpha)
    if not found:
        if component.name not in failed and component.name in {a.name for a in state.adopted}:
            raise UsageError(ADOPTED.format(component.name))
        reason = failed.get(component.name, "it has no regressor here that the calibration does not have already")
        raise DataError(f"{component.name} cannot be fitted to this survey: {reason}")
    model = replace(found[0].model, settings={**given, **found[0].model.settings})
    return replace(found[0].among(models), model=model)


def pinned(component: Component, settings: Mapping[str, Any]) -> Component:
    """An error model with some of its settings held; the others stay open."""
    if not settings:
        return component

    def held(x: Any, **rest: Any) -> Any:
        return component.function(x, **{**settings, **rest})

    first = next(iter(inspect.signature(component.function).parameters.values()))
    free = [p for name, p in component.parameters.items() if name not in settings]
    held.__signature__ = inspect.Signature([first, *free])  # type: ignore[attr-defined]
    held.__doc__ = component.function.__doc__
    return replace(component, function=held)


def judged(candidate: Candidate) -> str:
    """What the loop's gates say of a candidate."""
    gates = "significant, and predicts held-out blocks" if candidate.passes else "not adopted by the loop"
    return f"{gates}: {why(candidate, None)}"


def require_settings(component: Component, given: Mapping[str, Any]) -> None:
    """See that settings are known, and of their type.

    Raises
    ------
    UsageError: they are not.
    """
    from pydantic import ValidationError

    known = list(component.parameters)
    for name in given:
        if name not in known:
            near = did_you_mean(name, known) or (f"; it has {', '.join(known)}" if known else "; it has none")
            raise UsageError(f"{component.name} has no setting {name!r}{near}")
    try:
        component.options.model_validate(dict(given))
    except ValidationError as error:
        for one in error.errors(include_url=False):
            if one["type"] != "missing":
                raise UsageError(f"{component.name}: {one['loc'][0]}: {one['msg']}") from None


def _new_directions(chosen: Candidate, state: State) -> str:
    """In words, how much of a model C, o and the adopted models cannot make already, where that is not all of it.

    Raises
    ------
    DataError: it is nothing; the coefficients would be nothing too.
    """
    known = 0 if state.terms is None else estimated(state.residual, state.terms, chosen.assessment.colours).rank
    new, count = chosen.assessment.estimate.rank - known, chosen.terms.count
    if new <= 0:
        settings = "".join(f" {k}={v}" for k, v in chosen.model.settings.items())
        raise DataError(
            f"{chosen.model.name}{settings} cannot be told from the calibration as it is: it has no direction on this "
            "survey that C, o and what is adopted do not have already"
        )
    if new >= count:
        return ""
    return (
        f"of the {count} directions of its coefficients {new} can be told from the calibration as it is, of the others "
        "the coefficients say nothing"
    )
