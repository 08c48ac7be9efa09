"""What turns with the field faster than it is sampled is called no other thing that remembers the field."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loop_cases import adopted_names, linear_state, loaded, scenario, verdict_of

from magtensor.error_models.settings import Range
from magtensor.error_models.terms import Terms, joined
from magtensor.loop.evidence.gains import Gain
from magtensor.loop.fitting.model import Adopted, State
from magtensor.loop.fitting.separation import separated
from magtensor.loop.searching import unknown_rate
from magtensor.loop.searching.unknown_rate import of_the_rate, rate_instead
from magtensor.registry import Registry

REMEMBERS = ["hysteresis", "viscous_magnetisation"]
OF_THE_RATE = ["sampling_lag", "bandwidth", "eddy_current", "clock_drift"]
RESTS = {"type": "postures", "random_count": 60, "rest_s": 10.0, "turn_s": 3.0, "average": True}
QUICK = {"type": "tumbling", "duration_s": 900.0, "rate_rms_deg_s": 60.0, "rate_time_s": 1.0}  # 30 deg between samples


@pytest.mark.parametrize(
    "effect", ["bandwidth", *(pytest.param(e, marks=pytest.mark.long) for e in ("sampling_lag", "eddy_current"))]
)
def test_a_delay_where_the_rate_is_not_known_is_told(effect: str, tmp_path: Path) -> None:
    survey = scenario(4, {"type": effect, "rms_nT": 1.5}, motion=QUICK)
    found = verdict_of(tmp_path, survey, models=[*REMEMBERS, *OF_THE_RATE])
    assert not adopted_names(found)
    assert found["unexplained"]["present"]
    assert {n["error_model"] for n in found["not_tested"]} == set(OF_THE_RATE)
    refused = found["steps"][-1]["refused"]
    assert any("for which the field turns too fast between samples, explains more" in refused[n] for n in REMEMBERS)


@pytest.mark.long
@pytest.mark.parametrize("seed", [4, 5])
def test_what_remembers_the_field_is_found_all_the_same(seed: int, tmp_path: Path) -> None:
    survey = scenario(seed, {"type": "hysteresis", "rms_nT": 1.5}, motion=QUICK)
    assert adopted_names(verdict_of(tmp_path, survey, models=[*REMEMBERS, *OF_THE_RATE])) == {"hysteresis"}


def test_a_time_constant_is_no_shorter_than_the_samples_show(tmp_path: Path) -> None:
    """Where the rate of change is not known the field between two samples is not, either."""
    models = [Registry.load().find("error_model", name) for name in [*REMEMBERS, *OF_THE_RATE]]
    known, unknown = (
        linear_state(loaded(tmp_path, scenario(4, motion={**QUICK, "rate_rms_deg_s": rate}))).excitation
        for rate in (10.0, 60.0)
    )
    assert (known.turns, unknown.turns) == (True, False)
    assert not of_the_rate(known, models)
    assert [m.name for m in of_the_rate(unknown, models)] == OF_THE_RATE
    grid = Range(0.1, 100.0, count=7, spacing="log", sampled=True)
    assert min(grid.values(known)) >= grid.least(known) == known.spacing
    assert min(grid.values(unknown)) >= grid.least(unknown) == 2.0 * unknown.spacing
    assert Range(0.1, 100.0).least(unknown) < 0.1


@pytest.mark.parametrize(
    ("effect", "found", "seed"),
    [
        ("eddy_current", set(), 6),
        ("hysteresis", {"hysteresis"}, 6),
        *(pytest.param("eddy_current", set(), seed, marks=pytest.mark.long) for seed in (10, 11)),
    ],
)
def test_what_decays_between_postures_is_no_play_of_iron(
    effect: str, found: set[str], seed: int, tmp_path: Path
) -> None:
    """With nine coefficients a sensor play follows how a posture differs from the one before; what decays within a
    posture predicts more in sum, if not in every fold."""
    survey = scenario(seed, {"type": effect, "rms_nT": 4.5}, motion=RESTS | {"random_count": 136})
    told = verdict_of(tmp_path, survey, models=[*REMEMBERS, *OF_THE_RATE])
    assert adopted_names(told) == found
    assert found or told["unexplained"]["present"]


def test_postures_show_a_time_constant_of_one_of_them(tmp_path: Path) -> None:
    """Between two rests the platform turns steadily; what is not recorded there is none of what is not seen."""
    resting = linear_state(loaded(tmp_path, scenario(4, motion=RESTS))).excitation
    assert not resting.turns
    assert Range(0.1, 100.0, sampled=True).least(resting) == resting.spacing == pytest.approx(13.0)


@pytest.mark.parametrize(("beside", "refused"), [(44.0, False), (24.0, True), (5.0, True)])
def test_a_memory_that_explains_more_beside_a_quicker_one_is_a_memory(
    beside: float, refused: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a play between postures what is quicker may be ahead by its coefficients, and yet not be all."""
    state = linear_state(loaded(tmp_path, scenario(4, motion=RESTS)))
    model = Registry.load().find("error_model", "hysteresis")
    terms = model.function(state.excitation).at(state.residual.samples)
    in_one_fold = np.where(np.arange(10) == 3, beside + 36.0, -4.0)

    def fold_gain(state: State, colours: object, one: Terms, other: Terms | None = None) -> Gain:
        gained = np.full(10, 61.0) if one is terms else np.full(10, 67.0)
        return Gain(np.full(10, 1e3), 1e3 - gained - (0.0 if other is None else in_one_fold), np.full(10, 100.0))

    monkeypatch.setattr(unknown_rate, "fold_gain", fold_gain)
    chosen: Any = SimpleNamespace(
        terms=terms, model=Adopted(model, {}), assessment=SimpleNamespace(colours=state.colours), before=None
    )
    models = [Registry.load().find("error_model", name) for name in [*REMEMBERS, *OF_THE_RATE]]
    quicker = joined([terms])
    assert not separated(fold_gain(state, None, quicker, terms), fold_gain(state, None, quicker))
    assert ("something quicker would do" in rate_instead(chosen, state, models)) is refused
