"""Surveys with more samples than a search looks at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from loop_cases import BASE, loaded, scenario

from magtensor.loop.fitting.model import Fitting
from magtensor.loop.fitting.refit import joint_state
from magtensor.loop.long_record import on_every_sample, part_of
from magtensor.loop.searching.found import Search
from magtensor.loop.searching.search import search
from magtensor.loop.searching.unexplained import unexplained
from magtensor.registry import Registry

HOW = Fitting()
WHITE = {
    "instrument": BASE["instrument"] | {"noise": {"white_sd_nT": 0.15}},
    "base_station": {"rate_Hz": 2.0, "noise_sd_nT": 0.0, "resolution_nT": 0.001},
}
PART = 600  # of the survey's 2400 samples, at half a sample a second


def found_in_a_part(folder: Path, *names: str, **effect: object) -> Search:
    record = loaded(folder, scenario(11, {"rms_nT": 1.0} | effect, **WHITE))
    part = part_of(record, [], HOW, PART)
    assert len(part.record.time) == PART
    registry = Registry.load()
    models = [registry.find("error_model", name) for name in names]
    found = search(part.record, models, HOW, lines=part.lines)
    whole = on_every_sample(found, record, part)
    assert len(whole.last.residual.affine) > 0.99 * len(record.time)
    assert not unexplained(found, found.record)["present"]
    return whole


def test_a_short_survey_is_searched_as_it_is(tmp_path: Path) -> None:
    record = loaded(tmp_path, scenario(11))
    part = part_of(record, [], HOW)
    assert part.record is record and part.lines is None


def test_all_samples_determine_the_coefficients_of_what_a_part_shows(tmp_path: Path) -> None:
    """Four times the samples: half the standard deviation, in white noise."""
    whole = found_in_a_part(tmp_path, "nonlinearity_quadratic", "cross_field", type="nonlinearity_quadratic")
    assert [a.name for a in whole.last.adopted] == ["nonlinearity_quadratic"]
    few = part_of(whole.record, [], HOW, PART).record
    alone = joint_state(few, whole.last.adopted, HOW)
    assert alone.estimate is not None and whole.last.estimate is not None
    ratio = np.sqrt(np.diag(alone.estimate.covariance) / np.diag(whole.last.estimate.covariance))
    assert np.median(ratio) == pytest.approx(2.0, rel=0.15)


@pytest.mark.parametrize("periods", [277.0, 277.5, 1190.3], ids=["whole", "half", "near the end of the band"])
def test_the_frequency_of_a_tone_is_found_between_the_lines_of_a_spectrum(periods: float, tmp_path: Path) -> None:
    """Half a line off, three fifths of a tone's amplitude would be left."""
    effect = {"type": "periodic_interference", "frequency_Hz": periods / 1200.0, "rms_nT": 4.0}
    tones = [Registry.load().find("error_model", "periodic_interference")]
    found = search(loaded(tmp_path, scenario(12, effect, **WHITE)), tones, HOW)
    (tone,) = found.last.adopted
    assert tone.settings["frequency_Hz"] == pytest.approx(periods / 1200.0, abs=0.003 / 1200.0)
    assert found.last.residual.square() == pytest.approx(1.0, abs=0.1)


def test_a_tone_too_fast_for_the_part_keeps_its_frequency(tmp_path: Path) -> None:
    """0.83 Hz at 0.5 samples a second looks like 0.17 Hz."""
    whole = found_in_a_part(tmp_path, "periodic_interference", type="periodic_interference", frequency_Hz=0.83)
    (tone,) = whole.last.adopted
    assert tone.settings["frequency_Hz"] == pytest.approx(0.83, abs=1 / 1200)
    assert whole.last.residual.square() == pytest.approx(1.0, abs=0.1)
