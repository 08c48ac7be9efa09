"""Something that happened once beside a source nobody logged: a part of its course, or an event of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_cases import synthetic
from numpy.typing import NDArray
from scipy.signal import lfilter

from magtensor.loop.fitting.model import Adopted, Fitting, Record
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.searching.likeness import part_of_the_source
from magtensor.loop.searching.outcome import described
from magtensor.loop.searching.search import search
from magtensor.registry import Registry
from magtensor.tensor.geometry import standard_geometry

N = 2400
BEGIN, END = 1000, 1060
EVENT, SOURCE = (Registry.load().find("error_model", name) for name in ("offset_while", "latent_source"))
Array = NDArray[np.float64]


def burst(seed: int, of_its_own: bool) -> tuple[Record, Array]:
    """A source beside noise of 1 nT that for a minute is four times as strong, or something else is then, on three
    sensors; and the source's course."""
    rng = np.random.default_rng(seed)
    kept = np.exp(-1.0 / 20.0)
    wave = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], rng.standard_normal(N))
    vectors, others = rng.standard_normal((2, 4, 3))
    others[3] = 0.0
    during = (np.arange(N) >= BEGIN) & (np.arange(N) < END)
    event = 2.0 * during[:, None, None] * (others if of_its_own else vectors)
    record = synthetic(seed, N, added=2.0 * wave[:, None, None] * vectors + event)
    return replace(record, position=standard_geometry("cross", 0.5)), wave


@pytest.mark.parametrize("of_its_own", [False, True])
@pytest.mark.parametrize("sensors", [("S1", "S2", "S3"), (), ("S2",)])
@pytest.mark.parametrize("seed", range(2))
def test_its_vectors_tell(seed: int, sensors: tuple[str, ...], of_its_own: bool) -> None:
    record, wave = burst(seed, of_its_own)
    event = Adopted(EVENT, {"time_s": float(BEGIN), "until_s": float(END)}, sensors=sensors)
    adopted = [event, Adopted(SOURCE, {"noise_nT": [1.0] * 12})]
    state = joint_state(replace(record, waveform=wave), adopted, Fitting())
    assert part_of_the_source(state, 0) == (not of_its_own and len(sensors) != 1)
    assert not part_of_the_source(state, 1)


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 1, 2])
def test_a_burst_of_the_source_is_no_event(seed: int) -> None:
    found = search(burst(seed, False)[0], [EVENT, SOURCE], Fitting())
    assert [a.name for a in found.last.adopted] == ["latent_source"]


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_an_event_of_its_own_stays(seed: int) -> None:
    found = search(burst(seed, True)[0], [EVENT, SOURCE], Fitting())
    assert {a.name for a in found.last.adopted} == {"offset_while", "latent_source"}
    event = next(a for a in found.last.adopted if a.name == "offset_while")
    assert sorted(event.settings.values()) == pytest.approx([BEGIN, END], abs=3.0)


@pytest.mark.long
def test_a_step_of_what_a_channel_does_from_then_on_is_a_part_of_that() -> None:
    """A current that acts from midway on (a relay whose log is missing) has a mean: a jump takes that, and leaves what
    moves the sensors as it did."""
    rng = np.random.default_rng(12)
    level = np.repeat(rng.uniform(2.0, 4.0, 60), N // 60)
    acts = np.where(np.arange(N) < N // 2, 0.0, level)
    record = synthetic(12, N, noise_nT=0.3, added=np.multiply.outer(acts, rng.uniform(-0.5, 0.5, (4, 3))))
    warms = 1.0 / (1.0 + np.exp((N / 2 - np.arange(N)) / 60.0))  # goes with it by 0.7, and is not its cause
    logged, units = {"current_motor": level, "temperature": warms}, {"current_motor": "A", "temperature": "degC"}
    record = replace(record, logged=logged, units=units, origins=dict.fromkeys(logged, 0.0))
    models = [Registry.load().find("error_model", name) for name in ("offset_step", "current_field", "latent_source")]
    found = search(record, models, Fitting())
    assert [a.name for a in found.last.adopted] == ["latent_source"]
    [told] = described(found, found.record, 0)["adopted"]
    assert told["means"].startswith("goes as current_motor from") and "most_like_channel" not in told
