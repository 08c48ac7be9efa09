"""Lines that are no tones of their own: sidebands of one that changes, and what an adopted channel's law leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from loop_cases import Array, synthetic

from magtensor.loop.fitting.model import Adopted, Fitting, Record, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.remainder.tones import channels_of_the_line, tones
from magtensor.loop.searching.overshadowed import _of_one_tone
from magtensor.registry import Registry

SAMPLES = 2000
FIND = Registry.load().find
VECTORS = np.random.default_rng(3).standard_normal((4, 3))


def survey(course: Array, vectors: Array = VECTORS) -> Record:
    return synthetic(3, SAMPLES, added=course[:, None, None] * vectors, turning_s=7.0, noise_nT=0.15)


def with_tones(record: Record, frequencies_Hz: Sequence[float]) -> State:
    model = FIND("error_model", "periodic_interference")
    return joint_state(record, [Adopted(model, {"frequency_Hz": f}) for f in frequencies_Hz], Fitting())


TIME = np.arange(float(SAMPLES))


def tone(frequency_Hz: float) -> Array:
    return np.sin(2.0 * np.pi * frequency_Hz * TIME + 0.3)


def test_sidebands_are_told_from_tones() -> None:
    record = survey((1.0 + 0.9 * tone(0.004)) * tone(0.17))
    found = _of_one_tone(with_tones(record, [0.17, 0.166, 0.174]), 0)
    assert found is not None and sorted(found[0]) == [0, 1, 2]
    assert "0.166, 0.17, 0.174 Hz" in found[1]


def test_harmonics_of_one_source_are_tones() -> None:
    """Of a saw-tooth the fifth, sixth and seventh are as close as sidebands may be."""
    frequencies = [0.03 * k for k in range(1, 8)]
    record = survey(np.sum([tone(f) / k for k, f in enumerate(frequencies, start=1)], axis=0))
    assert _of_one_tone(with_tones(record, frequencies), 0) is None


def test_tones_of_several_sources_are_tones() -> None:
    frequencies = [0.17, 0.18, 0.19]
    each = np.random.default_rng(8).standard_normal((3, 4, 3))
    record = synthetic(
        3, SAMPLES, added=sum(tone(f)[:, None, None] * v for f, v in zip(frequencies, each, strict=True)),
        turning_s=7.0, noise_nT=0.15,
    )  # fmt: skip
    assert _of_one_tone(with_tones(record, frequencies), 0) is None


@pytest.mark.parametrize("logged", [True, False])
def test_what_the_law_of_an_adopted_channel_leaves_is_no_tone(logged: bool) -> None:
    """A servo that goes to and fro; its field goes with the size of its angle, which its square comes near."""
    angle = tone(0.021)
    other = np.random.default_rng(9).standard_normal(SAMPLES)
    record = replace(survey(2.0 * np.abs(angle)), logged={"servo": angle if logged else other})
    record = replace(record, units={"servo": "1"}, origins={"servo": np.zeros(())})
    square = Adopted(FIND("error_model", "channel_response"), {"channel": "servo", "power": 2})
    state = joint_state(record, [square], Fitting())
    assert bool(tones(state, record.time)) is not logged
    assert bool(channels_of_the_line(state.excitation, 0.042)) is logged
    assert tones(joint_state(record, [], Fitting()), record.time)  # nothing follows the servo yet
