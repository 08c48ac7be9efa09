"""The search taken in steps: by the loop, by a person, or by both in turn; every step can be undone.

Whatever a person adopts or rejects, the evidence is computed as for the loop's own choices and kept beside it.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from magtensor.calibration.joint import calibrated
from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.errors import DataError, NotEnoughData, UsageError, did_you_mean
from magtensor.loop.assessment import estimated
from magtensor.loop.decisions import Decision
from magtensor.loop.latent import NAME, renewed, sought, tried_source
from magtensor.loop.long_record import on_every_sample, part_of
from magtensor.loop.model import Adopted, Fitting, Record, State, joint_state, without
from magtensor.loop.needs import missing
from magtensor.loop.outcome import described, removal, why
from magtensor.loop.record import record_of
from magtensor.loop.screening import Candidate, candidates_of, profiled, repeatable
from magtensor.loop.search import Search, Step, adopt, search, simplest, with_lines
from magtensor.loop.settings import AnyChannel
from magtensor.loop.trial import trial
from magtensor.survey.model import Survey

PERSON, LOOP, DECLARED = "person", "loop", "declared"
_ADOPTED = "{} is adopted already; reject it or undo first to adopt it otherwise"


@dataclass(frozen=True)
class Moment:
    """Where an inquiry stands.

    Attributes:
        record: the samples, with the waveform of an adopted source that nobody logged.
        state: the fit with all that is adopted.
        by: who put each of the adopted models there: declared, loop or person.
        steps: the rounds so far, of the loop and by hand.
        made: decisions so far, each with what the loop computed of it.
        rejected: models rejected by hand, with what the loop computed of them.
        failed: model -> why its regressors could not be made.
        ended: the search that the loop has just ended; None after a decision by hand.
    """

    record: Record
    state: State
    by: tuple[str, ...]
    steps: tuple[Step, ...] = ()
    made: tuple[tuple[Decision, str], ...] = ()
    rejected: Mapping[str, str] | None = None
    failed: Mapping[str, str] | None = None
    ended: Search | None = None


class Inquiry:
    """A survey whose residual is being traced.

    Attributes:
        whole: all samples; the inquiry is into a part of them if they are very many.
        models: the error models that may be adopted.
        how: how the joint fit is made.
        first: the state with what was declared alone.
    """

    def __init__(
        self,
        record: Record,
        models: Sequence[Component],
        how: Fitting,
        *,
        declared: Sequence[Adopted] = (),
        most_effects: int,
        alpha: float,
    ) -> None:
        self.models, self.how = list(models), how
        self.declared, self.most_effects, self.alpha = list(declared), most_effects, alpha
        self.whole, self._part = record, part_of(record, declared, how)
        self._history: list[Moment] = []
        self._ranked: tuple[Candidate, ...] | None = None

    @property
    def now(self) -> Moment:
        """Where it stands; the first fit is made when it is first asked for."""
        if not self._history:
            state = joint_state(self._part.record, self.declared, self.how)
            self._history.append(Moment(self._part.record, state, (DECLARED,) * len(self.declared)))
        return self._history[-1]

    @property
    def first(self) -> State:
        """The state with what was declared alone."""
        assert self.now is not None
        return self._history[0].state

    def decide(self, decision: Decision) -> str:
        """Make a decision.

        Returns:
            What the loop computed of it, in words.

        Raises:
            UsageError: there is no such model or setting.
            DataError: the survey cannot have it; nothing has changed then.
        """
        if decision.action == "adopt":
            return self.adopt(decision.error_model, decision.settings)
        if decision.action == "reject":
            return self.reject(decision.error_model)
        return self.loop(decision.without)

    def undo(self) -> Decision:
        """Take the last decision back.

        Raises:
            UsageError: there is none.
        """
        made = self.now.made
        if not made:
            raise UsageError("there is nothing to undo")
        self._history.pop()
        self._ranked = None
        return made[-1][0]

    def add_models(self, models: Sequence[Component]) -> None:
        """More error models to choose from; what the loop has done before it did without them."""
        self.models += models
        names = tuple(m.name for m in models)

        def known_then(decision: Decision) -> Decision:
            return replace(decision, without=(*decision.without, *names)) if decision.action == "loop" else decision

        self._history = [replace(m, made=tuple((known_then(d), t) for d, t in m.made)) for m in self._history]
        self._ranked = None

    def left(self) -> tuple[Record, Array]:
        """The samples, and the calibrated field (N, S, 3) nT at them with all that is adopted taken off."""
        record, state = self.now.record, self.now.state
        raw, reference = without(record, [a.terms(state.excitation) for a in state.adopted], state.theta)
        b = calibrated(state.fit).apply(raw)
        return replace(record, total_field=reference), b

    def open_models(self) -> list[Component]:
        """The models that may be adopted now."""
        taken = {a.name for a in self.now.state.adopted}
        return [
            m
            for m in self.models
            if m.name not in (self.now.rejected or {}) and (m.name not in taken or repeatable(m)) and not self.lacks(m)
        ]

    def lacks(self, model: Component) -> list[str]:
        """What the survey lacks for a model."""
        return [] if model.name == NAME else missing(model, self.first.excitation)

    def ranking(self) -> tuple[Candidate, ...]:
        """The most promising models that are open, each with its best settings, by held-out gain."""
        if self._ranked is None:
            failed: dict[str, str] = {}
            models = [m for m in self.open_models() if m.name != NAME]
            state = with_lines(self.now.state, self.now.record, self._part.lines)
            self._ranked = tuple(candidates_of(state, models, failed, self.alpha))
            self._history[-1] = replace(self.now, failed={**(self.now.failed or {}), **failed})
        return self._ranked

    def adopt(self, name: str, settings: Mapping[str, Any] | None = None) -> str:
        """Adopt a model by hand, whatever the gates say; settings that are not given are searched.

        Returns, raises: as `decide`.
        """
        component, given = self._open(name), dict(settings or {})
        _require_settings(component, given)
        decision = Decision("adopt", name, given)
        if name == NAME:
            return self._adopt_source(component, decision)
        chosen = self._candidate(component, given)
        before = self.now
        _require_new_direction(chosen, before.state)
        standing = trial(before.record, before.state, self.how)
        after = trial(before.record, adopt(before.record, before.state, chosen, self.how), self.how)
        record, state = renewed(before.record, after.state, self.how)
        first, others = simplest(
            chosen, [c for c in self.ranking() if c.predicts and c.model.name != name], before.state
        )
        rivals = tuple(sorted({first.model.name, *others} - {name}))
        words = [_judged(chosen)]
        if hurt := standing.hurt_by(after):
            words.append(f"fitted, it raises the held-out error of {', '.join(hurt)}")
        if not standing.likelier(after):
            words.append("fitted together with the others, it leaves more than it takes away")
        told = "; ".join(words)
        step = Step(before.state, self.ranking() if chosen in self.ranking() else (chosen,), chosen, rivals)
        self._advance(decision, told, record, state, (*before.by, PERSON), step)
        return told

    def _adopt_source(self, component: Component, decision: Decision) -> str:
        before = self.now
        shared = sought(before.state, before.record)
        if shared is None:
            raise NotEnoughData("the survey has too few sensors or samples to show a source that nobody logged")
        shared, source = tried_source(component, before.record, before.state, shared, self.how, 1.0)
        if source is None:
            why_not = shared.objection or f"noise of the sensors alone explains it (p {shared.p:.2g})"
            raise DataError(f"no source that nobody logged can be taken off: {why_not}")
        told = f"p {shared.p:.2g}, held-out gain {shared.gain.total:.4g} (t {shared.gain.t:.2g})"
        step = Step(before.state, (), source.evidence)
        self._advance(decision, told, source.record, source.after, (*before.by, PERSON), step)
        return told

    def reject(self, name: str) -> str:
        """Reject a model by hand: it is taken out if it was adopted, and not considered again.

        Returns, raises: as `decide`.
        """
        component = self._known(name)
        before = self.now
        decision = Decision("reject", name)
        places = [i for i, a in enumerate(before.state.adopted) if a.name == name]
        if any(before.by[i] == DECLARED for i in places):
            raise UsageError(f"{name} is declared, it belongs to the model from the beginning")
        if not places:
            if name in (before.rejected or {}):
                raise UsageError(f"{name} is rejected already")
            told = self._words_of(component)
            rejected = {**(before.rejected or {}), name: told}
            self._advance(decision, told, before.record, before.state, before.by, None, rejected)
            return told
        parts = []
        for i in places:
            worse, better = removal(before.state, i)
            parts.append(f"held-out residual {better:.4g} nT with it, {worse:.4g} nT without")
        told = f"taken out again: {'; '.join(parts)}"
        rest = [i for i in range(len(before.by)) if i not in places]
        record = before.record if name != NAME else replace(before.record, waveform=None)
        adopted, theta = [before.state.adopted[i] for i in rest], [before.state.theta[i] for i in rest]
        record, state = renewed(record, joint_state(record, adopted, self.how, theta), self.how)
        rejected = {**(before.rejected or {}), name: told}
        self._advance(decision, told, record, state, tuple(before.by[i] for i in rest), None, rejected)
        return told

    def loop(self, leaving: Sequence[str] = ()) -> str:
        """Let the loop search, with all that is adopted kept and what was rejected left alone.

        Returns, raises: as `decide`.
        """
        before = self.now if self._history else None
        record = self._part.record if before is None else before.record
        begin = self.declared if before is None else list(before.state.adopted)
        closed = {*leaving, *((before.rejected or {}) if before else ())}
        models = [m for m in self.models if m.name not in closed]
        found = search(
            record, models, self.how, declared=begin, most_effects=self.most_effects, alpha=self.alpha,
            lines=self._part.lines,
        )  # fmt: skip
        if before is None:
            before = Moment(self._part.record, found.first, (DECLARED,) * len(self.declared))
            self._history.append(before)
        names = [a.name for a in found.last.adopted[len(begin) :]]
        told = f"adopted {', '.join(names)}" if names else "nothing to adopt"
        moment = Moment(
            found.record, found.last, (*before.by, *(LOOP for _ in names)), (*before.steps, *found.steps),
            (*before.made, (Decision("loop", without=tuple(leaving)), told)), before.rejected,
            {**(before.failed or {}), **found.failed}, found,
        )  # fmt: skip
        self._history.append(moment)
        self._ranked = None
        return told

    def found(self) -> Search:
        """The whole search as it stands, its last fit with what nothing explains left out as disturbed."""
        now, ended = self.now, self.now.ended
        not_tested = {m.name: tuple(lacks) for m in self.models if (lacks := self.lacks(m))}
        if ended is not None:
            return replace(ended, first=self.first, steps=now.steps, not_tested=not_tested, failed=now.failed or {})
        last = joint_state(
            now.record, now.state.adopted, replace(self.how, searching=False), now.state.theta, now.state.lines
        )
        steps = (*now.steps, Step(now.state, self.ranking(), None))  # a last look, as the loop takes one
        shared = sought(last, now.record)
        return Search(self.first, last, steps, not_tested, self.now.failed or {}, now.record, shared)

    def on_every_sample(self, found: Search) -> Search:
        """The search as it stands, its calibrations fitted to all samples."""
        return on_every_sample(found, self.whole, self._part, self.how)

    def told(self, found: Search) -> dict[str, Any]:
        """`adopted`, `rejected`, `not_tested`, `steps` of the verdict and, where a person had a hand, `decisions`."""
        now = self.now
        outcome = described(found, now.record, len(self.declared))
        for one, by in zip(outcome["adopted"], now.by[len(self.declared) :], strict=True):
            one["by"] = by
        hands = dict(now.rejected or {})
        for one in outcome["adopted"]:
            words = [told for d, told in now.made if d.action == "adopt" and d.error_model == one["error_model"]]
            if one["by"] == PERSON and words:
                one["evidence"]["judged"] = words[-1]
        outcome["rejected"] = sorted(
            [
                *({**r, "by": LOOP} for r in outcome["rejected"] if r["error_model"] not in hands),
                *({"error_model": n, "why": f"by hand; {told}", "by": PERSON} for n, told in hands.items()),
            ],
            key=lambda r: str(r["error_model"]),
        )
        if any(d.action != "loop" for d, _ in now.made):
            outcome["decisions"] = [{"decision": str(d), "evidence": told} for d, told in now.made]
        return outcome

    def _advance(
        self,
        decision: Decision,
        told: str,
        record: Record,
        state: State,
        by: tuple[str, ...],
        step: Step | None,
        rejected: Mapping[str, str] | None = None,
    ) -> None:
        before = self.now
        if rejected is None:
            rejected = {n: w for n, w in (before.rejected or {}).items() if n != decision.error_model}
        steps = before.steps if step is None else (*before.steps, step)
        made = (*before.made, (decision, told))
        self._history.append(Moment(record, state, by, steps, made, rejected, before.failed))
        self._ranked = None

    def _known(self, name: str) -> Component:
        if not isinstance(name, str):
            raise UsageError(f"an error model is given by its name, not as {name!r}")
        for model in self.models:
            if model.name == name:
                return model
        if name in {a.name for a in self.declared}:
            return next(a.component for a in self.declared if a.name == name)
        names = [m.name for m in self.models]
        near = did_you_mean(name, names) or f"; there are {', '.join(sorted(names))}"
        raise UsageError(f"no error model is called {name!r}{near}")

    def _open(self, name: str) -> Component:
        component = self._known(name)
        if name in {a.name for a in self.now.state.adopted} and not repeatable(component):
            raise UsageError(_ADOPTED.format(name))
        if lacks := self.lacks(component):
            logged = ", ".join(sorted(self.first.excitation.logged)) or "no channel"
            raise DataError(f"{name} needs {' and '.join(lacks)}, which this survey lacks; it logs {logged}")
        return component

    def _candidate(self, component: Component, given: dict[str, Any]) -> Candidate:
        """A model with its best settings, those given held."""
        if not given:
            for candidate in self.ranking():
                if candidate.model.name == component.name:
                    return candidate
        channels = [n for n, g in profiled(component).items() if isinstance(g, AnyChannel) and n in given]
        for adopted in self.now.state.adopted:
            if adopted.name == component.name and given.items() <= adopted.settings.items():
                raise UsageError(f"{component.name} is adopted already with these settings")
            if adopted.name == component.name and any(adopted.settings.get(c) == given.get(c) for c in channels):
                raise UsageError(_ADOPTED.format(component.name))
        failed: dict[str, str] = {}
        state = with_lines(self.now.state, self.now.record, self._part.lines)
        found = candidates_of(state, [pinned(component, given)], failed, self.alpha)
        if not found:
            if component.name not in failed and component.name in {a.name for a in self.now.state.adopted}:
                raise UsageError(_ADOPTED.format(component.name))
            reason = failed.get(component.name, "it has no regressor here that the calibration does not have already")
            raise DataError(f"{component.name} cannot be fitted to this survey: {reason}")
        models = max(len(self.open_models()), 1)
        p, null_p = (min(1.0, each * models) for each in (found[0].adjusted_p, found[0].adjusted_null_p))
        model = replace(found[0].model, settings={**given, **found[0].model.settings})
        return replace(found[0], model=model, adjusted_p=p, adjusted_null_p=null_p)

    def _words_of(self, component: Component) -> str:
        if lacks := self.lacks(component):
            return f"it could not be tried: the survey lacks {' and '.join(lacks)}"
        for candidate in self.ranking():
            if candidate.model.name == component.name:
                return _judged(candidate)
        return "not among the most promising when it was rejected"


def inquiry_of(
    survey: Survey,
    declared: Mapping[str, tuple[Component, Mapping[str, Any]]],
    models: Iterable[Component],
    how: Fitting,
    *,
    most_effects: int,
    alpha: float,
) -> Inquiry:
    """An inquiry into a survey.

    Raises:
        NotEnoughData: no samples are left in use.
    """
    record = record_of(survey)
    if len(record.time) < 2:
        raise NotEnoughData("no samples are left in use", where=str(survey.attributes.get("source", "")))
    begin = [Adopted(component, settings) for component, settings in declared.values()]
    names = {a.name for a in begin}
    open_ = [m for m in models if m.name not in names]
    return Inquiry(record, open_, how, declared=begin, most_effects=most_effects, alpha=alpha)


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


def _require_new_direction(chosen: Candidate, state: State) -> None:
    """Refuse a model whose regressors C, o and the adopted models can make already: its coefficients would be nothing.

    Raises:
        DataError: it is one.
    """
    known = 0 if state.terms is None else estimated(state.residual, state.terms, chosen.assessment.colours).rank
    if chosen.assessment.estimate.rank <= known:
        settings = "".join(f" {k}={v}" for k, v in chosen.model.settings.items())
        raise DataError(
            f"{chosen.model.name}{settings} cannot be told from the calibration as it is: it has no direction on this "
            "survey that C, o and what is adopted do not have already"
        )


def _judged(candidate: Candidate) -> str:
    gates = "passes the first two gates of the loop" if candidate.passes else "does not pass the gates of the loop"
    return f"{gates}: {why(candidate, None)}"


def _require_settings(component: Component, given: Mapping[str, Any]) -> None:
    """Settings must be known, and of their type."""
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
