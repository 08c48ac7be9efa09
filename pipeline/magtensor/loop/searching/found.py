"""What a search has found: its rounds, and where it ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from magtensor.error_models.waveform import NAME
from magtensor.loop.fitting.model import Fitting, Record, State
from magtensor.loop.fitting.refit import settled
from magtensor.loop.fitting.trial import Trial
from magtensor.loop.searching.contribution import removal
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.latent import Sought


@dataclass(frozen=True)
class Step:
    """One round of the search: what was looked at and what was done.

    Attributes:
        before: state before; candidates: by held-out gain, best first.
        adopted: the candidate adopted, None where none was.
        rivals: names of models that the data do not separate from it.
        dropped: models dropped after the refit.
        refused: model -> why it was not kept after it had been fitted.
        among: the sensors looked at, where some that wander were left out; () where all were.
        channels: others that the data do not separate from the one that it follows.
        like: the channel that the waveform of a source nobody logged is like; "" where there is none.
        screened: names of the models that were tried with every setting, those looked at closely among them.
    """

    before: State
    candidates: tuple[Candidate, ...]
    adopted: Candidate | None
    rivals: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    refused: Mapping[str, str] = field(default_factory=dict)
    among: tuple[str, ...] = ()
    channels: tuple[str, ...] = ()
    like: str = ""
    screened: tuple[str, ...] = ()


@dataclass(frozen=True)
class Kept:
    """The outcome of a round.

    Attributes:
        standing: how the fit stands; None where nothing was kept.
        chosen, rivals, channels, dropped, refused: as in `Step`.
        then: the step of what was adopted with it, or nothing.
    """

    standing: Trial | None
    chosen: Candidate | None = None
    rivals: tuple[str, ...] = ()
    channels: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    refused: Mapping[str, str] = field(default_factory=dict)
    then: tuple[Step, ...] = ()

    def step(self, before: State, candidates: Sequence[Candidate]) -> Step:
        """The round's story; what follows another channel than its candidate did stands in its place, and a curve that
        was none of the candidates behind them."""
        kept = self.chosen
        told = tuple(kept if kept and c.model.name == kept.model.name else c for c in candidates)
        if kept and all(c is not kept for c in told):
            told = (*told, kept)
        return Step(before, told, kept, self.rivals, self.dropped, self.refused, channels=self.channels)


@dataclass(frozen=True)
class Ended:
    """Where rounds of a search ended: nothing more is adopted.

    Attributes:
        record: as in `Search`; state: the fit with all that was adopted; how: it was made.
        steps: in order; shared: the waveform that the sensors share.
    """

    record: Record
    state: State
    how: Fitting
    steps: tuple[Step, ...]
    shared: Sought | None

    @cached_property
    def settled(self) -> State:
        """The fit without the samples that nothing explains."""
        return settled(self.record, self.state, self.how)

    @property
    def adopts(self) -> bool:
        """Whether anything was adopted."""
        return any(step.adopted is not None for step in self.steps)


@dataclass(frozen=True)
class Search:
    """The whole search.

    Attributes:
        first, last: states with the declared model and with all that was adopted.
        steps: in order.
        not_tested: model -> what the survey lacks for it.
        failed: model -> why its regressors could not be made.
        record: the samples, with the waveform of a source that nobody logged where one was adopted.
        shared: the waveform that the sensors share after all that was adopted; None where it cannot be asked for.
        how: how the fit of the last state was made.
        evenly: that state with the sensors weighed by their white noise, where they were weighed by all (`wandering`).
    """

    first: State
    last: State
    steps: tuple[Step, ...]
    not_tested: Mapping[str, tuple[str, ...]]
    failed: Mapping[str, str]
    record: Record
    shared: Sought | None
    how: Fitting
    evenly: State | None = None

    @property
    def told(self) -> State:
        """The state by which it is told what is left."""
        return self.evenly or self.last


def without_and_with(found: Search, *places: int) -> tuple[float, float]:
    """Held-out rms of the residual in nT without and with some of the adopted models, the others in both; of a source
    that nobody logged, whose waveform has seen the data since, as it was when it was adopted."""
    if [found.last.adopted[place].name for place in places] == [NAME]:
        for step in reversed(found.steps):
            if step.adopted is not None and step.adopted.model.name == NAME:
                before, after = step.adopted.assessment.gain.rms
                return before * step.before.residual.scale, after * step.before.residual.scale
    return removal(found.told, *places)
