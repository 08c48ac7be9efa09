"""Which candidate a round fits next: what is said against each before it is fitted, and what falls with it if it fails.

Whatever is said against the best one, the next best has its turn; and where a curve of a channel may explain what it
does, the curves of that channel are candidates too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from magtensor.components import Component
from magtensor.loop.fitting.model import CHANNEL, Record, State
from magtensor.loop.remainder.tones import channels_of_the_line
from magtensor.loop.searching.any_law import OUTPUTS, outdone_by
from magtensor.loop.searching.by_its_name import by_its_name
from magtensor.loop.searching.contribution import tones_of
from magtensor.loop.searching.course_of_time import (
    beside_time,
    channels_in_time,
    is_a_course,
    responses_like,
    rivals_in_time,
)
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.keeping import MAYBE_HEAT, NOT_AS_ASSUMED, OF_AN_AXIS, ONE_OF_A_KIND, UNEARNED
from magtensor.loop.searching.larger_law import follows_the_attitude
from magtensor.loop.searching.part_of_a_waveform import part_of_a_waveform
from magtensor.loop.searching.rivals import (
    as_predictive,
    by_a_worse_log,
    containing,
    events_like,
    overlaps,
    part_of,
    part_of_a_drift,
    simplest,
    stands_for_less,
)
from magtensor.loop.searching.switched_with import of_no_law, switched_with
from magtensor.loop.searching.which_channel import nearest

AS_LASTING = "{}, which lasts, predicts as much"


@dataclass(frozen=True)
class Proposal:
    """A candidate to be fitted, and the names of models and of channels that the data do not separate from its own."""

    chosen: Candidate
    rivals: tuple[str, ...]
    channels: tuple[str, ...]


@dataclass
class Choosing:
    """The candidates of a round.

    Attributes:
        record: the samples; state: the fit beside which the candidates were found.
        candidates: all of them; models: how many models they were found among.
        curves_of: what follows any curve of a channel, and passes.
        of_another: why a candidate is taken for a part of what another model explains; "" if it is not.
        anything: the model that follows any channel; None where it is not among those that may be adopted.
        left: the candidates that may still be fitted; refused: model -> why it may not.
        asked: channels whose curves have had their turn; outdone: candidates that these explain more than.
        courses: candidates that are no more than smooth courses of time.
    """

    record: Record
    state: State
    candidates: Sequence[Candidate]
    models: int
    curves_of: Callable[[str], Sequence[Candidate]]
    of_another: Callable[[Candidate], str]
    anything: Component | None
    left: list[Candidate] = field(init=False)
    refused: dict[str, str] = field(default_factory=dict)
    asked: set[str] = field(default_factory=set)
    outdone: list[Candidate] = field(default_factory=list)
    courses: list[Candidate] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.left = list(self.candidates)

    @property
    def best(self) -> Candidate | None:
        """Of those left that pass the one that gains most; None where none passes."""
        return max((c for c in self.left if c.passes), key=lambda c: c.assessment.gain.total, default=None)

    def asks_for_other_laws(self) -> bool:
        """Whether there are curves, not asked so far, of the channels of those left that go by another law than
        theirs."""
        x = self.state.excitation
        return self._ask(name for c in self.left if c.unlike_its_law for name in c.model.channels(x))

    def proposed(self, best: Candidate) -> Proposal | None:
        """The simplest of what the data do not tell from the best; None where something is said against it, or others
        have to be looked at first."""
        possible = [c for c in self.left if c.predicts]
        best = containing(best, possible, self.state)
        simple, rivals = simplest(best, possible, self.state)
        chosen = self._by_its_name(simple)
        if self._lasts(chosen) or self._is_of_another(chosen):
            return None
        switched = switched_with(chosen.model, self.state)
        if self._is_switched(chosen, switched) or self._may_be_a_curve(chosen):
            return None
        chosen, channels = nearest(chosen, self.state, self.models, self.anything)
        lines = [c for f in tones_of(chosen.model) for c in channels_of_the_line(self.state.excitation, f)]
        if same := (*switched, *lines, *channels_in_time(chosen, self.state)):
            channels, rivals = same, (*rivals, CHANNEL)
        time = beside_time(chosen, self.state)
        if time.refused:
            self._refuse(chosen.model.name, time.refused)
            self.courses.append(chosen)
            return None
        if self._is_outdone(chosen):
            return None
        alike = {*rivals, simple.model.name, *self._like(chosen)} - {chosen.model.name}
        if not time.seen:
            alike |= set(rivals_in_time(chosen, possible, self.state))
        return Proposal(chosen, tuple(sorted(alike)), channels)

    def fails(self, chosen: Candidate, why: str) -> None:
        """Once fitted it is not kept; neither are those that stand for less of the same, and what it had taken the
        place of has its turn again where its own law is not what was assumed."""
        name = chosen.model.name
        self._refuse(name, why)
        if why == OF_AN_AXIS:
            self._ask([OUTPUTS])
        if why == NOT_AS_ASSUMED:
            for c in self._in_the_place_of(chosen):
                if self.refused.pop(c.model.name, ""):
                    self.left.append(c)
        if why == UNEARNED:
            return
        for c in [c for c in self.left if c.passes]:
            if part_of(c, chosen, self.state):
                self._refuse(c.model.name, f"a small part of what {name} explains, which failed")
            elif why == ONE_OF_A_KIND and overlaps(c, chosen, self.state):
                self._refuse(c.model.name, f"most of it is what the law of {name} leaves")
            elif why == MAYBE_HEAT and stands_for_less(c, chosen, self.state):
                self._refuse(c.model.name, f"{name} explains the same and more, and failed")

    def _by_its_name(self, simple: Candidate) -> Candidate:
        """A candidate, in the place of one that says nothing of its cause the effect that is the same thing: that may
        have been refused, with the settings it had."""
        named = by_its_name(simple, self.candidates, self.state)
        if named is not simple:
            self.left[:] = [named if c is simple else c for c in self.left if c.model.name != named.model.name]
            self.refused.pop(named.model.name, None)
        return named

    def _refuse(self, name: str, why: str) -> None:
        self.refused[name] = why
        self.left[:] = [c for c in self.left if c.model.name != name]

    def _ask(self, channels: Iterable[str]) -> bool:
        """Whether there are channels whose curves had not had their turn."""
        new = sorted(set(channels) - self.asked)
        self.asked.update(new)
        self.left.extend(c for channel in new for c in self.curves_of(channel))
        return bool(new)

    def _lasts(self, chosen: Candidate) -> bool:
        """Whether something that lasts takes the place of an event."""
        lawful = [c for c in self.candidates if self.refused.get(c.model.name) != NOT_AS_ASSUMED]
        lasting = part_of_a_drift(chosen, lawful, self.state)
        if lasting is None:
            return False
        self._refuse(chosen.model.name, AS_LASTING.format(lasting.model.name))
        self.left[:] = [lasting if c.model.name == lasting.model.name else c for c in self.left]
        return True

    def _in_the_place_of(self, lasting: Candidate) -> list[Candidate]:
        """The events whose place something that lasts has taken."""
        why = AS_LASTING.format(lasting.model.name)
        return [c for c in self.candidates if self.refused.get(c.model.name) == why]

    def _is_of_another(self, chosen: Candidate) -> bool:
        """Whether it is refused as a part of something else."""
        why = self.of_another(chosen) or part_of_a_waveform(chosen, self.state, self.record)
        if not why:
            return False
        self._refuse(chosen.model.name, why)
        if follows_the_attitude(chosen.model, self.state):
            self._ask([OUTPUTS])
        return True

    def _is_switched(self, chosen: Candidate, channels: Sequence[str]) -> bool:
        """Whether channels that are switched when it begins and ends are asked first, or it is no law of theirs."""
        if self._ask(channels):
            return True
        why = of_no_law(chosen, channels, [*self.candidates, *self.left], self.state)
        if why:
            self._refuse(chosen.model.name, why)
        return bool(why)

    def _may_be_a_curve(self, chosen: Candidate) -> bool:
        """Whether it is a course of time, and curves of the channels are asked first: what rises with time may be any
        curve of what did."""
        x = self.state.excitation
        return is_a_course(chosen.model, x) and self._ask(name for name in x.logged if not x.is_vector(name))

    def _is_outdone(self, chosen: Candidate) -> bool:
        """Whether it is refused as any curve of a channel explains more."""
        channel = outdone_by(chosen, self.state)
        if channel:
            self.outdone.append(chosen)
            self._refuse(chosen.model.name, f"any curve of {channel} explains more")
            self._ask([channel])
        return bool(channel)

    def _like(self, chosen: Candidate) -> set[str]:
        """The models of the other candidates that the data do not separate from it."""
        alike = as_predictive(chosen, self.candidates, self.state) | by_a_worse_log(chosen, self.outdone, self.state)
        events = events_like(chosen, self._in_the_place_of(chosen), self.state)
        return alike | events | responses_like(chosen, self.courses, self.state)
