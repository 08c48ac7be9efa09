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

    def open_models(self, state: State) -> list[Component]:
        """The models that have what they need and are not in already, or can be in more than once."""
        taken = {a.name for a in state.adopted}
        return [m for m in testable(state.excitation, self.models) if m.name not in taken or repeatable(m)]

    def curves_of(self, channel: str, state: State) -> list[Candidate]:
        """What follows any curve of a channel, and passes."""
        return by_any_law_of(channel, state, self.open_models(state), self.alpha)

    def run(self, record: Record, state: State, how: Fitting) -> Ended:
        """Adopt the best, refit, repeat, until nothing is left that the data want."""
        shared: Sought | None = None
        standing = trial(record, state, how)
        steps: list[Step] = []
        asked = False  # whether something simpler does as well
        for _ in range(self.most_effects + 2):
            state = with_lines(state, record, self.lines)
            if len(state.adopted) - self.fixed >= self.most_effects or state.residual.square() < ROUNDING:
                break
            candidates = self.candidates(state, record, how)
            open_ = len(testable(state.excitation, self.models))
            adopted = self.first_kept(record, standing, candidates, how, open_)
            step = adopted.step(state, candidates)
            steps.append(replace(step, screened=tuple(m.name for m in self.open_models(state))))
            steps.extend(adopted.then)
            if adopted.standing is not None:
                record, state = renewed(record, adopted.standing.state, how)
                places = range(self.fixed, len(state.adopted))
                standing = on_more_sensors(record, replace(adopted.standing, state=state), how, places[:-1])
                standing, gone = in_the_place_of_others(record, standing, how, places)
                state = standing.state
                if gone:
                    steps[-1] = replace(steps[-1], dropped=(*steps[-1].dropped, *gone))
                if by_a_curve(state.adopted[-1]):  # of more pieces, before anything is adopted for what it leaves
                    standing, more = by_any_law(
                        record, standing, how, [len(state.adopted) - 1], self.alpha, open_, self.fixed
                    )
                    state, steps = standing.state, [*steps, *more]
                continue
            instead = None if asked else exchanged(record, state, steps, how, self.fixed, open_)
            if instead is None and not asked:
                instead = with_another_lag(record, state, how, self.fixed, open_, self.alpha)
            asked = True
            if instead is not None:
                after, step = instead
                if self.say is not None and step.adopted is not None:
                    self.say(f"{step.adopted.model.name} takes the place of {', '.join(step.refused)}")
                steps[-1] = step
                record, state = renewed(record, after.state, how)
                standing = replace(after, state=state)
                continue
            places = range(self.fixed, len(state.adopted))
            standing, more = by_any_law(record, standing, how, places, self.alpha, open_, self.fixed)
            if more:
                if self.say is not None:
                    self.say("following any curve of a channel")
                record, state = renewed(record, standing.state, how)
                standing, steps = replace(standing, state=state), [*steps, *more]
                continue
            shared = sought(state, record)
            kept = self.by_its_channel(record, standing, shared, how, open_)
            if kept.standing is None and (ends := at_an_end(settled(record, state, how))):
                curves = [c for channel in ends for c in self.curves_of(channel, state)]
                kept = self.first_kept(record, standing, curves, how, open_, with_others=False)
            if kept.standing is None and by_what_they_read(state).any():
                kept = self.first_kept(record, standing, self.curves_of(OUTPUTS, state), how, open_, with_others=False)
            if kept.standing is not None:
                steps.append(kept.step(state, [kept.chosen] if kept.chosen else []))
                record, state = renewed(record, kept.standing.state, how)
                shared, standing = None, replace(kept.standing, state=state)
                continue
            shared, found = self.with_source(record, state, how, steps[-1], shared)
            if found is None:
                break
            record, state, steps[-1] = found
            shared, standing = None, trial(record, state, how)
        return Ended(record, state, how, tuple(steps), shared)

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
            if self.say is not None:
                self.say(f"adopting {chosen.model.name}")
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
        if self.say is not None:
            self.say(f"adopting {NAME}")
        record, state = source.record, source.after
        last, dropped = eliminate(record, state, how, self.fixed)
        if parts := [i for i in range(self.fixed, len(last.adopted)) if part_of_the_source(last, i)]:
            dropped = (*dropped, *(last.adopted[i].name for i in parts))
            last = without_models(record, last, parts, how)
        if dropped and NAME not in dropped:  # what had taken a part of the source for its own
            record, state = renewed(record, last, how)
        gone = (*([instead] if instead else []), *(() if NAME in dropped else dropped))
        return None, (record, state, replace(step, adopted=source.evidence, dropped=gone, like=source.like))


def testable(x: Excitation, models: Sequence[Component]) -> list[Component]:
    """The models that have what they need, beside what is adopted."""
    return [m for m in models if not missing(m, x)]


def with_lines(state: State, record: Record, lines: Sequence[float] | None = None) -> State:
    """The state, its excitation knowing the strongest lines in the spectrum of what is left, or those given."""
    if lines is None:
        lines = tones(state, record.time)
    return replace(state, excitation=replace(state.excitation, lines=tuple(lines)))
