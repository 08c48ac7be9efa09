"""A verdict in lines: one for all that is unexplained, one for all that was noted."""

from __future__ import annotations

from typing import Any

import pytest

from magtensor.verdict_words import lines, lines_of_the_rest, sentence

ERROR = {"total_field_rms_nT": {"all": 0.4}, "tensor_rms_nT_per_m": None}
LEFT = {"present": True, "description": "S2 is off; S3 is slow; 3 samples are spikes"}
PARTS = {"findings": ["S2 is off", "S3 is slow; it goes in jumps"], "notes": ["3 samples are spikes"]}


def outcome(**unexplained: Any) -> dict[str, Any]:
    return {
        "declared": ["linear"],
        "adopted": [],
        "noise_floor_nT": 0.2,
        "error": {"fit": ERROR},
        "unexplained": unexplained,
        "attitude": {"description": "the attitude is late"},
    }


def test_each_thing_has_a_line_under_its_heading() -> None:
    told = lines(outcome(**LEFT, **PARTS))
    assert told[0].endswith("sensor noise 0.2 nT.") and "no known effect explains" in told[0]
    assert told[1:] == [
        "Unexplained:",
        "  - S2 is off",
        "  - S3 is slow; it goes in jumps",
        "Noted:",
        "  - 3 samples are spikes",
        "  - the attitude is late",
    ]
    assert lines_of_the_rest(LEFT | PARTS) == told[1:-1]


def test_the_sentence_holds_the_same() -> None:
    said = sentence(outcome(**LEFT, **PARTS))
    assert said.endswith(
        "; unexplained: S2 is off; S3 is slow; it goes in jumps; 3 samples are spikes; the attitude is late."
    )
    assert said.count("unexplained") == 1


def test_noise_is_said_once_and_what_was_noted_beside_it() -> None:
    calm = {"present": False, "description": "", "findings": ["white", "slow by 0.1 nT"], "notes": ["a spike"]}
    head, *others = lines(outcome(**calm))
    assert "what is left looks like noise" in head and "white" not in head
    assert others == ["Noted:", "  - slow by 0.1 nT", "  - a spike", "  - the attitude is late"]
    assert lines_of_the_rest(calm) == ["white", "Noted:", "  - slow by 0.1 nT", "  - a spike"]
    alone = {"present": False, "description": "", "findings": ["white"], "notes": []}
    assert lines_of_the_rest(alone) == ["white"]


@pytest.mark.parametrize(("present", "heading"), [(True, "Unexplained:"), (False, "Noted:")])
def test_a_verdict_that_tells_all_in_one_string_is_split(present: bool, heading: str) -> None:
    """As those of archives processed before are."""
    told = lines(outcome(**(LEFT | {"present": present})))
    first = ["  - S2 is off"] if present else []
    assert told[1:] == [heading, *first, "  - S3 is slow", "  - 3 samples are spikes", *told[len(first) + 4 :]]
    assert told[-1] == "  - the attitude is late"


def test_a_run_without_the_loop_has_its_head_alone() -> None:
    never = {"present": None, "description": "not looked for", "findings": [], "notes": []}
    assert lines(outcome(**never) | {"attitude": {}}) == [
        "Calibrated with the linear model: total field 0.4 nT rms on the survey it was fitted to; sensor noise 0.2 nT."
    ]
