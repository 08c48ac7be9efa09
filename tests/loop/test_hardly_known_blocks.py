"""A block of whose calibration the others know little judges that, and not an effect that is asked about."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from loop_cases import Array, linear_state, synthetic

from magtensor.error_models.terms import Terms
from magtensor.loop.evidence.assessment import WHITE, assess
from magtensor.loop.evidence.gains import Gain
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.fitting.model import Adopted, Fitting, Record
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.fitting.trial import WORST_RISE, BlockErrors, Trial, trial
from magtensor.registry import Registry

LEGS = [(1.0, 0.0, 0.1), (0.0, -1.0, 0.1), (-1.0, 0.0, 0.1), (0.0, -1.0, 0.1), (1.0, 0.0, 0.1)]  # along the field
IN_A_LEG = 240


def flown(seed: int, within_deg: float) -> Record:
    """Five legs, of which the third alone has its heading: the others do not know the offset along it."""
    record = synthetic(seed, samples=60_000, sensors=3)
    direction = record.raw.mean(axis=1)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    legs = []
    for leg in LEGS:
        near = direction @ np.array(leg) / np.linalg.norm(leg) > np.cos(np.deg2rad(within_deg))
        legs.append(np.flatnonzero(near)[:IN_A_LEG])
    rows = np.concatenate(legs)
    of_a_sample = dict.fromkeys(("run", "segment"), np.zeros(len(rows), dtype=int))
    field = record.total_field
    assert field is not None and len(rows) == IN_A_LEG * len(LEGS)
    return replace(
        record,
        raw=record.raw[rows],
        total_field=field[rows],
        quiet_field=field[rows],
        time=np.arange(float(len(rows))),
        samples=np.arange(len(rows)),
        **of_a_sample,
    )


def with_cross_field(record: Record, nT_at_full_scale: float) -> Record:
    """Every axis shows of the two others their product and the difference of their squares, over 50 000 nT."""
    x, y, z = np.moveaxis(record.raw, 2, 0) / 5e4
    shown = np.stack([y * z + y**2 - z**2, z * x + z**2 - x**2, x * y + x**2 - y**2], axis=2)
    return replace(record, raw=record.raw + nT_at_full_scale * shown)


@pytest.mark.parametrize(("seed", "within_deg"), [(2, 10.0), (3, 8.0)])
def test_the_leg_with_a_heading_of_its_own_is_no_judge(seed: int, within_deg: float) -> None:
    """The effect is there; on that leg the error rises by chance with the calibration that the others give it."""
    record = with_cross_field(flown(seed, within_deg), 25.0)
    model = Adopted(Registry.load().find("error_model", "cross_field"), {}, ())
    before, after = (trial(record, joint_state(record, models, Fitting()), Fitting()) for models in ([], [model]))
    assert before.blocks is not None and after.blocks is not None
    for blocks in (before.blocks, after.blocks):
        np.testing.assert_array_equal(blocks.hardly_known.any(axis=1), [False, False, True, False, False])
    everywhere = {s: after.blocks.rms()[s] / e for s, e in before.blocks.rms().items()}
    assert min(everywhere.values()) > 1.0 + WORST_RISE  # as if the effect hurt all of them
    assert before.hurt_by(after) == []
    assert before.helped_by(after) == list(record.sensors)


def judged(held_out: Array, within: Array) -> Trial:
    """A trial with these squares in blocks of ten samples, of one sensor."""
    of_one = [np.asarray(a, dtype=float)[:, None] for a in (held_out, within)]
    blocks = BlockErrors(("S1",), np.full(of_one[0].shape, 10), *of_one)
    state: Any = None
    return Trial(state, blocks, np.arange(0, 10 * len(held_out) + 1, 10))


WITHIN = np.full(3, 10.0)  # nT^2, 1 nT rms


@pytest.mark.parametrize(
    ("before", "after", "hurt"),
    [
        ([10, 10, 1000], [10, 10, 2000], False),  # the last is not known either way
        ([10, 10, 10], [10, 10, 2000], True),  # it was known
        ([15, 15, 1000], [10, 10, 2000], False),
        ([10, 10, 1000], [15, 15, 2000], True),
        ([1000, 1000, 1000], [2000, 2000, 2000], True),  # none is known, and something has to judge
    ],
)
def test_only_blocks_that_are_not_known_with_and_without_are_left_out(
    before: list[float], after: list[float], hurt: bool
) -> None:
    """Errors of three blocks; the rest of the rule is that of the gate, a tenth."""
    found = judged(np.array(before), WITHIN).hurt_by(judged(np.array(after), WITHIN))
    assert found == (["S1"] if hurt else [])


FROM_S, UNTIL_S = 620.0, 680.0  # half of the sixth of ten folds


def beside_an_event(nT_on: float, *, everywhere: bool) -> Gain:
    """What a heater of 0.6 nT gains beside an offset of one sensor for a minute, which one fold alone tells of."""
    record = synthetic(4)
    heater = np.sin(record.time / 19.0) > 0.0
    on = (record.time >= FROM_S) & (record.time < UNTIL_S)
    raw = record.raw.copy()
    raw[:, 1] += np.outer(0.6 * heater + nT_on * on, [1.0, -0.5, 0.5])
    logged = {"current_heater": heater.astype(float)}
    channels: dict[str, Any] = {"units": {"current_heater": "A"}, "origins": {"current_heater": 0.0}}
    state = linear_state(replace(record, raw=raw, logged=logged, **channels))

    def terms_of(name: str, **settings: Any) -> Terms:
        made: Terms = Registry.load().find("error_model", name).function(state.excitation, **settings)
        return made.at(state.residual.samples)

    event = terms_of("offset_while", time_s=FROM_S, until_s=UNTIL_S)
    white = Whitened.of(state.residual, WHITE.across, WHITE.along, event)
    return assess(white, terms_of("current_field"), everywhere=everywhere).gain


def test_where_an_event_is_known_from_alone_is_no_judge_of_others() -> None:
    """What the event does there, which the others leave, goes with the heater by chance: in one sense or the other."""
    found, by_chance = (
        [beside_an_event(sign * 100.0, everywhere=everywhere) for sign in (-1.0, 1.0)] for everywhere in (False, True)
    )
    for gain in found:
        assert gain.judges is not None and gain.judges.tolist() == [0, 1, 2, 3, 4, 6, 7, 8, 9]
        assert gain.consistent and not gain.contradicted
    assert found[0].total == pytest.approx(found[1].total, rel=0.05)
    assert min(gain.total for gain in by_chance) < 0.0 < max(gain.total for gain in by_chance)


def test_gains_are_compared_on_the_folds_that_judged_both() -> None:
    some = np.array([0, 1, 2, 4])
    few, all_ = Gain(np.full(4, 9.0), np.full(4, 7.0), np.full(4, 50.0), some), Gain(*np.full((3, 5), 8.0))
    assert few.over(all_).total == pytest.approx(4.0) and all_.over(few).total == pytest.approx(-4.0)
    assert all_.over(all_).total == 0.0 and len(all_.over(all_).values) == 5
