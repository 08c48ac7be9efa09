"""The search taken in steps: by the loop, by a person, or by both in turn; every step can be undone.

Whatever a person adopts or rejects, the evidence is computed as for the loop's own choices and kept beside it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from magtensor.calibration.joint import calibrated
from magtensor.calibration.types import Array
from magtensor.components import Component
from magtensor.error_models.needs import missing
from magtensor.errors import DataError, UsageError, did_you_mean
from magtensor.loop.decisions import Decision
from magtensor.loop.fitting.model import Adopted, Fitting, Record, State, as_declared
from magtensor.loop.fitting.record import record_of
from magtensor.loop.fitting.refit import joint_state, require_more_than_a_constant, without
from magtensor.loop.fitting.wandering import unweighed
from magtensor.loop.long_record import on_every_sample, part_of
from magtensor.loop.searching import by_hand
from magtensor.loop.searching.by_hand import ByHand
from magtensor.loop.searching.found import Search, Step
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.latent import NAME, sought
from magtensor.loop.searching.outcome import described
from magtensor.loop.searching.own_fit import at_their_own_fit
from magtensor.loop.searching.profiling import repeatable
from magtensor.loop.searching.rounds import with_lines
from magtensor.loop.searching.screening import candidates_of
from magtensor.loop.searching.search import search
from magtensor.survey.model import Survey

PERSON, LOOP, DECLARED = "person", "loop", "declared"


@dataclass(frozen=True)
class Moment:
    """Where an inquiry stands.

    Attributes:
        record: the samples, with the waveform of an adopted source that nobody logged.
        state: the fit with all that is adopted; how: it was made.
        by: who put each of the adopted models there: declared, loop or person.
        steps: the rounds so far, of the loop and by hand.
        made: decisions so far, each with what the loop computed of it.
        rejected: models rejected by hand, with what the loop computed of them.
        failed: model -> why its regressors could not be made.
        ended: the search that the loop has just ended; None after a decision by hand.
    """

    record: Record
    state: State
    how: Fitting
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
            require_more_than_a_constant(self._part.record, self.how)
            state = joint_state(self._part.record, self.declared, self.how)
            self._history.append(Moment(self._part.record, state, self.how, (DECLARED,) * len(self.declared)))
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
        return [] if model.name == NAME else missing(model, self.now.state.excitation)

    def ranking(self) -> tuple[Candidate, ...]:
        """The most promising models that are open, each with its best settings, by held-out gain."""
        if self._ranked is None:
            failed: dict[str, str] = {}
            models = [m for m in self.open_models() if m.name != NAME]
            state = with_lines(self.now.state, self.now.record, self._part.lines)
            found = candidates_of(state, models, failed, self.alpha)
            self._ranked = tuple(at_their_own_fit(found, self.now.record, state, self.now.how))
            self._history[-1] = replace(self.now, failed={**(self.now.failed or {}), **failed})
        return self._ranked

    def adopt(self, name: str, settings: Mapping[str, Any] | None = None) -> str:
        """Adopt a model by hand, whatever the gates say; settings that are not given are searched.

        Returns, raises: as `decide`.
        """
        component, given = self._open(name), dict(settings or {})
        by_hand.require_settings(component, given)
        decision = Decision("adopt", name, given)
        before = self.now
        if name == NAME:
            done = by_hand.source_adopted(before.record, before.state, component, before.how)
            return self._advance(decision, done, (*before.by, PERSON))
        chosen = self._candidate(component, given)
        done = by_hand.adopted(before.record, before.state, chosen, self.ranking(), before.how)
        return self._advance(decision, done, (*before.by, PERSON))

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
            return self._advance(decision, ByHand(told, before.record, before.state, None), before.by, rejected)
        done = by_hand.taken_out(before.record, before.state, places, before.how)
        rejected = {**(before.rejected or {}), name: done.told}
        return self._advance(decision, done, tuple(b for i, b in enumerate(before.by) if i not in places), rejected)

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
            record, models, self.how if before is None else before.how, declared=begin,
            most_effects=self.most_effects, alpha=self.alpha, lines=self._part.lines,
        )  # fmt: skip
        if before is None:
            before = Moment(self._part.record, found.first, self.how, (DECLARED,) * len(self.declared))
            self._history.append(before)
        names = [a.name for a in found.last.adopted[len(begin) :]]
        told = f"adopted {', '.join(names)}" if names else "nothing to adopt"
        moment = Moment(
            found.record, found.last, found.how, (*before.by, *(LOOP for _ in names)), (*before.steps, *found.steps),
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
            now.record, now.state.adopted, replace(now.how, searching=False), now.state.theta, now.state.lines
        )
        steps = (*now.steps, Step(now.state, self.ranking(), None))  # a last look, as the loop takes one
        shared = sought(last, now.record)
        evenly = unweighed(now.record, last, now.how)
        return Search(self.first, last, steps, not_tested, self.now.failed or {}, now.record, shared, now.how, evenly)

    def on_every_sample(self, found: Search) -> Search:
        """The search as it stands, its calibrations fitted to all samples."""
        return on_every_sample(found, self.whole, self._part)

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
        self, decision: Decision, done: ByHand, by: tuple[str, ...], rejected: Mapping[str, str] | None = None
    ) -> str:
        before = self.now
        if rejected is None:
            rejected = {n: w for n, w in (before.rejected or {}).items() if n != decision.error_model}
        steps = before.steps if done.step is None else (*before.steps, done.step)
        made = (*before.made, (decision, done.told))
        self._history.append(Moment(done.record, done.state, before.how, by, steps, made, rejected, before.failed))
        self._ranked = None
        return done.told

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
            raise UsageError(by_hand.ADOPTED.format(name))
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
        state = with_lines(self.now.state, self.now.record, self._part.lines)
        return by_hand.candidate(component, given, state, len(self.open_models()), self.alpha)

    def _words_of(self, component: Component) -> str:
        if lacks := self.lacks(component):
            return f"it could not be tried: the survey lacks {' and '.join(lacks)}"
        for candidate in self.ranking():
            if candidate.model.name == component.name:
                return by_hand.judged(candidate)
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
    begin = as_declared(declared.values(), record.time)
    names = {a.name for a in begin}
    open_ = [m for m in models if m.name not in names]
    return Inquiry(record, open_, how, declared=begin, most_effects=most_effects, alpha=alpha)
