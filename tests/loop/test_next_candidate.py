"""Which candidate a round keeps: another where the first does not earn its place, and what lasts before an event."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from loop_cases import BASE, adopted_names, scenario, verdict_of

from magtensor.loop import rivals, rounds
from magtensor.loop.model import Adopted, Fitting, Record, State
from magtensor.registry import Registry

EFFECTS = ({"type": "temperature_offset", "rms_nT": 1.0}, {"type": "nonlinearity_cubic", "rms_nT": 0.6})


def test_what_is_dropped_at_once_does_not_end_the_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first model is dropped at its first trial, as if it raised the error on held-out blocks."""
    first: list[str] = []

    def strict(record: Record, state: State, how: Fitting, fixed: int) -> tuple[State, tuple[str, ...]]:
        if first:
            return state, ()
        first.append(state.adopted[-1].name)
        return rounds.without_models(record, state, [len(state.adopted) - 1], how), (first[0],)

    monkeypatch.setattr(rounds, "eliminate", strict)
    survey = scenario(33, *EFFECTS, motion=BASE["motion"] | {"duration_s": 600.0})
    told = verdict_of(tmp_path, survey, models=[str(e["type"]) for e in EFFECTS])

    assert "does not earn its place" in told["steps"][0]["refused"][first[0]]
    assert adopted_names(told) == {"temperature_offset", "nonlinearity_cubic"}  # the first one in the second round
    assert told["steps"][1]["adopted"] == first[0]


def candidate(name: str, gain: float, *, rank: int = 4, passes: bool = True) -> Any:
    component = Registry.load().find("error_model", name)
    assessment = SimpleNamespace(gain=SimpleNamespace(total=gain), estimate=SimpleNamespace(rank=rank))
    return SimpleNamespace(model=Adopted(component, {}), assessment=assessment, passes=passes)


@pytest.mark.parametrize(
    ("other", "instead"),
    [
        (candidate("sampling_lag", 42000.0), True),
        (candidate("sampling_lag", 27000.0), False),  # predicts less
        (candidate("sampling_lag", 42000.0, passes=False), False),
        (candidate("bandwidth", 43000.0, rank=12), False),  # has more coefficients
        (candidate("channel_response", 43000.0), False),  # names nothing
        (candidate("scale_step", 43000.0), False),  # happens once too
    ],
)
def test_a_slip_is_no_simpler_than_a_delay_that_predicts_more(other: Any, instead: bool) -> None:
    slip = candidate("lag_step", 27600.0)
    assert rivals.lasting_instead(slip, [slip, other]) is (other if instead else slip)


def test_what_lasts_stays() -> None:
    delay, drift = candidate("sampling_lag", 100.0), candidate("clock_drift", 200.0)
    assert rivals.lasting_instead(delay, [delay, drift]) is delay
