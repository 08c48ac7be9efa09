"""The rounds of a search: the best candidate that passes is adopted, everything is refitted, and so on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from magtensor.components import Component
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.needs import missing
from magtensor.loop.fitting.model import CHANNEL, Fitting, Record, State
from magtensor.loop.fitting.refit import settled
from magtensor.loop.fitting.trial import Trial, on_the_folds_of, trial
from magtensor.loop.remainder.predictable import by_what_they_read
from magtensor.loop.remainder.tones import tones
from magtensor.loop.searching.another_lag import with_another_lag
from magtensor.loop.searching.any_law import OUTPUTS, at_an_end, by_a_curve, by_any_law, by_any_law_of
from magtensor.loop.searching.beside_a_hole import of_a_hole
from magtensor.loop.searching.choosing import Choosing
from magtensor.loop.searching.contribution import eliminate, without_models
from magtensor.loop.searching.course_of_time import (
    beside_time,
)
from magtensor.loop.searching.exchange import exchanged, looked_at_again
from magtensor.loop.searching.found import Ended, Kept, Step
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.keeping import (
    UNEARNED,
    Fitted,
    fitted,
    fitted_everywhere,
    why_not,
)
from magtensor.loop.searching.larger_law import part_of_a_gradient, part_of_a_larger_law
from magtensor.loop.searching.latent import NAME, Sought, renewed, sought, source_instead, tried_source
from magtensor.loop.searching.like_a_station import stations_like
from magtensor.loop.searching.likeness import followed_by_a_curve, part_of_the_source
from magtensor.loop.searching.on_fewer_sensors import on_those_needed
from magtensor.loop.searching.on_more_sensors import in_the_place_of_others, on_more_sensors
from magtensor.loop.searching.own_fit import at_their_own_fit
from magtensor.loop.searching.profiling import repeatable
from magtensor.loop.searching.rivals import (
    hardly_less,
    hindered_by_another,
    part_of_a_drift,
)
from magtensor.loop.searching.screening import candidates_of
from magtensor.loop.searching.split import split
from magtensor.loop.searching.unknown_rate import rate_instead

ROUNDING = 1e-4  # mean square of the whitened residual: far below the least noise that any sensor is believed to have
MOST_BESIDE = 2  # fits of another beside what fails alone: of two that hinder each other each is the first to be seen


@dataclass
class Rounds:
    """The rounds of a search, in each of which an effect is adopted.

    Attributes:
        models, most_effects, alpha, lines, say: as in `search`; fixed: how many models were declared.
        failed: model -> why its regressors could not be made.
        sought_beside: names of a candidate that failed alone, and of what was adopted, where another was sought too.
        whole: the fit with the samples that were taken out because nothing explains them, or they are loud; None where
            none were.
    """

    models: Sequence[Component]
    fixed: int
    most_effects: int
    alpha: float
    lines: Sequence[float] | None
    say: Callable[[str], None] | None
    failed: dict[str, str] = field(default_factory=dict)
    sought_beside: set[tuple[str, ...]] = field(default_factory=set)
    whole: State | None = None

    def candidates(self, state: State, record: Record, how: Fitting) -> list[Candidate]:
        """What may be adopted beside what is."""
        models = self.open_models(state)
        found = at_their_own_fit(candidates_of(state, models, self.failed, self.alpha), record, state, how)
        for two in split(state, self.fixed, self.alpha, len(models)):
            same = next((c for c in found if c.model.name == two.model.name), None)
            if two.passes and (
                same is None or not same.passes or same.assessment.gain.total < two.assessment.gain.total
            ):
                found = [c for c in found if c is not same] + [two]
        return sorted(found, key=lambda c: -c.assessment.gain.total)

    def tell(self, line: str) -> None:
        """A line about the round, to whoever listens."""
        if self.say is not None:
            self.say(line)

    def open_models(self, state: State) -> list[Component]:
        """The models that have what they need and are not in already, or can be in more than once."""
        taken = {a.name for a in state.adopted}
        return [m for m in testable(state.excitation, self.models) if m.name not in taken or repeatable(m)]

    def curves_of(self, channel: str, state: State) -> list[Candidate]:
        """What follows any curve of a channel, and passes."""
        return by_any_law_of(channel, state, self.open_models(state), self.alpha)

    def run(self, record: Record, state: State, how: Fitting) -> Ended:
        """Adopt the best, refit, repeat, until nothing is left that the data want."""
        going = _Progress(self, record, state, how, trial(record, state, how))
        for _ in range(self.most_effects + 2):
            if going.ends():
                break
            if not (
                going.adopts_the_best()
                or going.exchanges()
                or going.bends_what_is_adopted()
                or going.adopts_a_curve()
                or going.adopts_a_source()
            ):
                break
        return Ended(going.record, going.state, how, tuple(going.steps), going.shared)

    def first_kept(
        self,
        record: Record,
        before: Trial,
        candidates: Sequence[Candidate],
        how: Fitting,
        models: int,
        *,
        with_others: bool = True,
        most_fits: int | None = None,
    ) -> Kept:
        """Fit the candidates that pass, found among so many models, the best first, until one is kept, or so many have
        been; one that fails on held-out blocks, before it is fitted or after, may be kept with another beside it."""
        state = before.state
        anything = next((m for m in self.models if m.name == CHANNEL), None)
        choosing = Choosing(
            record, state, candidates, models, partial(self.curves_of, state=state),
            partial(self.of_another, state=state), anything,
        )  # fmt: skip
        fits = 0
        while True:
            best = choosing.best
            if with_others and (hindered := hindered_by_another(best, choosing.left, state)):
                with_others = False
                if two := self.kept_with_another(record, before, hindered, candidates, how, models):
                    return replace(two, refused=choosing.refused)
            if best is None:
                if choosing.asks_for_other_laws():
                    continue
                break
            proposal = choosing.proposed(best)
            if proposal is None:
                continue
            chosen, rivals, channels = proposal.chosen, proposal.rivals, proposal.channels
            if (fits := fits + 1) > (most_fits or fits):
                break
            self.tell(f"adopting {chosen.model.name}")
            tried, dropped = self.eliminated(record, before, chosen, fitted(record, before, chosen, how), how)
            if (tried.hurt or tried.why == UNEARNED) and with_others:
                with_others = False  # a search beside it takes as long as a round
                if two := self.with_another(record, before, chosen, tried, how):
                    return replace(two, rivals=rivals, channels=channels, refused=choosing.refused)
            if tried.after is None or tried.why:
                choosing.fails(chosen, tried.why)
                continue
            alike = stations_like(tried.after.state, self.models) | hardly_less(chosen, dropped, state)
            rivals = tuple(sorted({*rivals, *alike}))
            return Kept(tried.after, chosen, rivals, channels, dropped, choosing.refused)
        return Kept(None, refused=choosing.refused)

    def eliminated(
        self, record: Record, before: Trial, chosen: Candidate, tried: Fitted, how: Fitting
    ) -> tuple[Fitted, tuple[str, ...]]:
        """A candidate that is kept, without the models that are no longer needed beside it; and their names."""
        if tried.after is None or tried.why:
            return tried, ()
        last, dropped = eliminate(record, tried.after.state, how, self.fixed)
        if chosen.model.name in dropped and len(last.adopted) <= len(before.state.adopted):
            return replace(tried, why=UNEARNED), ()
        if not dropped:
            return tried, ()
        if last.adopted[-1].name == chosen.model.name:  # beside what is gone it may have seemed to be on more
            last = on_those_needed(record, last, len(last.adopted) - 1, how)
        return replace(tried, after=trial(record, last, how)), dropped

    def of_another(self, chosen: Candidate, state: State) -> str:
        """Why a candidate, before it is fitted, is taken for a part of what another model explains, or nothing does; ""
        if it is not."""
        if why := rate_instead(chosen, state, self.models):
            return why
        if self.whole is not None and (why := of_a_hole(chosen, state, self.whole, len(self.models))):
            return why
        return part_of_a_larger_law(chosen, state) or part_of_a_gradient(chosen, state)

    def kept_with_another(
        self,
        record: Record,
        before: Trial,
        chosen: Candidate,
        candidates: Sequence[Candidate],
        how: Fitting,
        models: int,
    ) -> Kept | None:
        """One of the candidates that does not predict by itself, if it passes both gates beside what is found when it
        is in, and would not be refused as one that passes."""
        state = before.state
        if part_of_a_drift(chosen, candidates, state) or self.of_another(chosen, state):
            return None
        if beside_time(chosen, state).refused:
            return None
        two = self.with_another(record, before, chosen, fitted_everywhere(record, before, chosen, how), how)
        if two is None or two.standing is None:
            return None
        without = without_models(record, two.standing.state, [len(state.adopted)], how)
        beside = looked_at_again(without, chosen, models)
        return None if beside is None else replace(two, chosen=beside)

    def with_another(
        self, record: Record, before: Trial, chosen: Candidate, alone: Fitted, how: Fitting
    ) -> Kept | None:
        """A candidate kept together with what is found beside it, where alone it fails on held-out blocks; None where
        nothing is found, or both do not help the sensors that it hurts.

        Of two effects that follow one trend each is fitted with the other's part in it, and so predicts blocks worse
        than none. Asked once beside what is adopted: other samples or fewer sensors show no other pair.
        """
        asked = (chosen.model.name, *(a.name for a in before.state.adopted))
        if alone.after is None or asked in self.sought_beside:
            return None
        if len(alone.after.state.adopted) - self.fixed >= self.most_effects:
            return None
        self.sought_beside.add(asked)
        state = with_lines(alone.after.state, record, self.lines)
        candidates = self.candidates(state, record, how)
        open_ = len(testable(state.excitation, self.models))
        standing, few = replace(alone.after, state=state), MOST_BESIDE
        second = self.first_kept(record, standing, candidates, how, open_, with_others=False, most_fits=few)
        both = second.standing
        if both is None or second.dropped:
            return None
        before = on_the_folds_of(both, record, before, how)
        helped = before.helped_by(both)
        if before.hurt_by(both) or not set(alone.hurt) <= set(helped) or why_not(record, before, both, chosen, how):
            return None
        return Kept(both, chosen, then=(second.step(state, candidates),))

    def by_its_channel(self, record: Record, standing: Trial, shared: Sought | None, how: Fitting, models: int) -> Kept:
        """What a waveform that the sensors share comes from, alone or with another, where a curve of a logged channel
        predicts it: then the source is logged, and only its law had no name."""
        if shared is None or not shared.significant:
            return Kept(None)
        channel = followed_by_a_curve(shared.time, shared.values, record)
        state = standing.state
        curves = self.curves_of(channel, state) if channel else []
        return self.first_kept(record, standing, curves, how, models, with_others=False)

    def with_source(
        self, record: Record, state: State, how: Fitting, step: Step, shared: Sought | None
    ) -> tuple[Sought | None, tuple[Record, State, Step] | None]:
        """The waveform that the sensors share, and the fit with a source nobody logged that makes it; None where none
        is adopted."""
        hidden = next((m for m in self.models if m.name == NAME), None)
        if shared is None or hidden is None or NAME in {a.name for a in state.adopted}:
            return shared, None
        shared, source = tried_source(hidden, record, state, shared, how, self.alpha)
        instead = None
        if source is None and shared.left_by:
            instead = shared.left_by
            source = source_instead(hidden, record, state, shared, how, self.fixed, self.alpha)
        if source is None:
            return shared, None
        self.tell(f"adopting {NAME}")
        record, state = source.record, source.after
        last, dropped = eliminate(record, state, how, self.fixed)
        if parts := [i for i in range(self.fixed, len(last.adopted)) if part_of_the_source(last, i)]:
            dropped = (*dropped, *(last.adopted[i].name for i in parts))
            last = without_models(record, last, parts, how)
        if dropped and NAME not in dropped:  # what had taken a part of the source for its own
            record, state = renewed(record, last, how)
        gone = (*([instead] if instead else []), *(() if NAME in dropped else dropped))
        return None, (record, state, replace(step, adopted=source.evidence, dropped=gone, like=source.like))


@dataclass
class _Progress:
    """How far the rounds of a search have come; each method says whether something was adopted, or changed.

    Attributes:
        rounds: the search; record: the samples; state: the fit, which knows the lines in what it leaves; how: it is
            made; standing: how it does on held-out blocks.
        steps: the rounds so far; shared: the waveform that the sensors share beside all that was adopted.
        asked: whether something simpler was looked for in the place of what was adopted; open_: how many models the
            round looks at.
    """

    rounds: Rounds
    record: Record
    state: State
    how: Fitting
    standing: Trial
    steps: list[Step] = field(default_factory=list)
    shared: Sought | None = None
    asked: bool = False
    open_: int = 0

    def ends(self) -> bool:
        """Whether nothing more may be adopted, or nothing is left."""
        rounds = self.rounds
        self.state = with_lines(self.state, self.record, rounds.lines)
        self.open_ = len(testable(self.state.excitation, rounds.models))
        full = len(self.state.adopted) - rounds.fixed >= rounds.most_effects
        return full or self.state.residual.square() < ROUNDING

    def adopts_the_best(self) -> bool:
        """Of all candidates."""
        rounds, before = self.rounds, self.state
        candidates = rounds.candidates(before, self.record, self.how)
        kept = rounds.first_kept(self.record, self.standing, candidates, self.how, self.open_)
        step = kept.step(before, candidates)
        self.steps += [replace(step, screened=tuple(m.name for m in rounds.open_models(before))), *kept.then]
        if kept.standing is None:
            return False
        self._stands(kept.standing)
        places = self._adopted
        more = on_more_sensors(self.record, self.standing, self.how, places[:-1])
        self.standing, gone = in_the_place_of_others(self.record, more, self.how, places)
        self.state = self.standing.state
        if gone:
            self.steps[-1] = replace(self.steps[-1], dropped=(*self.steps[-1].dropped, *gone))
        if by_a_curve(self.state.adopted[-1]):  # of more pieces, before anything is adopted for what it leaves
            self._bends([len(self.state.adopted) - 1])
        return True

    def exchanges(self) -> bool:
        """What does as well, or another lag, in the place of what was adopted; asked once."""
        if self.asked:
            return False
        self.asked = True
        rounds, record, how = self.rounds, self.record, self.how
        instead = exchanged(record, self.state, self.steps, how, rounds.fixed, self.open_)
        if instead is None:
            instead = with_another_lag(record, self.state, how, rounds.fixed, self.open_, rounds.alpha)
        if instead is None:
            return False
        after, step = instead
        if step.adopted is not None:
            rounds.tell(f"{step.adopted.model.name} takes the place of {', '.join(step.refused)}")
        self.steps[-1] = step
        self._stands(after)
        return True

    def bends_what_is_adopted(self) -> bool:
        """Any curve of the channel that an adopted model follows, in its place."""
        if not self._bends(self._adopted):
            return False
        self.rounds.tell("following any curve of a channel")
        self._stands(self.standing)
        return True

    def adopts_a_curve(self) -> bool:
        """Curves of the channel that the shared waveform goes with, of those at an end of their range where samples fit
        nothing, or of what an axis reads."""
        rounds, record, state, how = self.rounds, self.record, self.state, self.how
        self.shared = sought(state, record)
        kept = rounds.by_its_channel(record, self.standing, self.shared, how, self.open_)
        if kept.standing is None and (ends := at_an_end(settled(record, state, how))):
            curves = [c for channel in ends for c in rounds.curves_of(channel, state)]
            kept = rounds.first_kept(record, self.standing, curves, how, self.open_, with_others=False)
        if kept.standing is None and by_what_they_read(state).any():
            curves = rounds.curves_of(OUTPUTS, state)
            kept = rounds.first_kept(record, self.standing, curves, how, self.open_, with_others=False)
        if kept.standing is None:
            return False
        self.steps.append(kept.step(state, [kept.chosen] if kept.chosen else []))
        self._stands(kept.standing)
        self.shared = None
        return True

    def adopts_a_source(self) -> bool:
        """One that nobody logged."""
        self.shared, found = self.rounds.with_source(self.record, self.state, self.how, self.steps[-1], self.shared)
        if found is None:
            return False
        self.record, self.state, self.steps[-1] = found
        self.shared, self.standing = None, trial(self.record, self.state, self.how)
        return True

    @property
    def _adopted(self) -> range:
        """The places of what the search has adopted."""
        return range(self.rounds.fixed, len(self.state.adopted))

    def _stands(self, standing: Trial) -> None:
        """From here on."""
        self.record, self.state = renewed(self.record, standing.state, self.how)
        self.standing = replace(standing, state=self.state)

    def _bends(self, places: Sequence[int]) -> bool:
        """Whether some of the models follow other curves now."""
        alpha, fixed = self.rounds.alpha, self.rounds.fixed
        self.standing, more = by_any_law(self.record, self.standing, self.how, places, alpha, self.open_, fixed)
        if more:
            self.state = self.standing.state
            self.steps += more
        return bool(more)


def testable(x: Excitation, models: Sequence[Component]) -> list[Component]:
    """The models that have what they need, beside what is adopted."""
    return [m for m in models if not missing(m, x)]


def with_lines(state: State, record: Record, lines: Sequence[float] | None = None) -> State:
    """The state, its excitation knowing the strongest lines in the spectrum of what is left, or those given."""
    if lines is None:
        lines = tones(state, record.time)
    return replace(state, excitation=replace(state.excitation, lines=tuple(lines)))
