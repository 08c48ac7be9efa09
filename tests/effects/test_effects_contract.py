"""What holds for every error model of the catalogue, and for the surveys they are given."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
import pytest
from pydantic import Field

import magtensor_effects
from magtensor.components import Component, component_of, error_model
from magtensor.error_models.example import example_survey
from magtensor.error_models.needs import missing
from magtensor.error_models.settings import Range
from magtensor.loop.checker import check_error_model
from magtensor.registry import Registry

# DESIGN section 5, without the base model `linear`; its several steps of an offset are also one that goes back.
CATALOGUE = {
    "instrument": {
        "temperature_offset", "temperature_scale", "temperature_rate", "offset_drift", "scale_drift", "warm_up",
        "current_field", "supply_scale", "supply_offset", "nonlinearity_quadratic", "nonlinearity_cubic",
        "cross_field", "hysteresis", "offset_step", "sampling_lag", "eddy_current", "bandwidth", "clock_drift",
        "crosstalk", "viscous_magnetisation", "moving_part", "periodic_interference", "frame_flexure",
        "channel_response", "finite_baseline", "position_error", "baseline_expansion", "latent_source",
        "scale_step", "turn_step", "calibration_step", "offset_while", "lag_step", "averaging",
        "temperature_alignment", "alignment_drift", "channel_alignment", "channel_rate",
    },
    "site": {"fixed_source", "site_gradient", "passing_source"},
    "reference": {"reference_scale", "reference_clock", "reference_drift", "reference_step", "reference_while"},
}  # fmt: skip


def components() -> dict[str, Component]:
    found = {n: component_of(getattr(magtensor_effects, n)) for n in magtensor_effects.__all__}
    return {n: c for n, c in found.items() if c is not None}


def test_the_catalogue_is_complete_and_registered() -> None:
    given = {kind: {n for n, c in components().items() if c.effect == kind} for kind in CATALOGUE}
    assert given == CATALOGUE
    registry = Registry.load()
    assert set().union(*CATALOGUE.values()) <= set(registry.names("error_model"))


@pytest.mark.parametrize("name", magtensor_effects.__all__)
def test_the_checker_finds_nothing(name: str) -> None:
    assert check_error_model(getattr(magtensor_effects, name)) == []


NEEDED = {
    "temperature_offset": ["temperature*"],
    "temperature_scale": ["temperature*"],
    "temperature_rate": ["temperature*"],
    "temperature_alignment": ["temperature*"],
    "current_field": ["current_*"],
    "supply_scale": ["supply*"],
    "supply_offset": ["supply*"],
    "moving_part": ["encoder*"],
    "frame_flexure": ["acceleration|attitude"],
    "fixed_source": ["attitude", "position"],
    "site_gradient": ["attitude", "position"],
    "crosstalk": ["position", "gradient"],
    "position_error": ["position", "gradient"],
    "finite_baseline": ["position", "travel"],
    "baseline_expansion": ["position", "gradient", "temperature*"],
    "reference_scale": ["base_station"],
    "reference_clock": ["base_station"],
    "reference_drift": ["base_station"],
    "reference_step": ["base_station"],
    "reference_while": ["base_station"],
    "latent_source": ["waveform"],
    "sampling_lag": ["rotation"],
    "eddy_current": ["rotation"],
    "bandwidth": ["rotation"],
    "clock_drift": ["rotation"],
    "lag_step": ["rotation"],
    "averaging": ["rotation", "total_field"],
}


@pytest.mark.parametrize("name", magtensor_effects.__all__)
def test_what_a_bare_survey_lacks_is_named(name: str) -> None:
    component = components()[name]
    bare = replace(
        example_survey(component, postures=True, uniform=True),
        logged={},
        units={},
        position=None,
        attitude=None,
        total_field=None,
        waveform=None,
    )
    lacks = missing(component, bare)
    assert lacks == NEEDED.get(name, [])
    if not lacks and not name.startswith("channel_"):
        terms = component.function(bare)
        assert np.isfinite(terms.series).all()


def test_a_constant_is_no_base_station() -> None:
    """Nor is what interpolation makes of one."""
    component = components()["reference_step"]
    x = example_survey(component)
    assert x.total_field is not None and missing(component, x) == []
    constant = np.full_like(x.total_field, 44_400.0) + 1e-9 * np.arange(len(x.time))
    assert missing(component, replace(x, total_field=constant)) == ["base_station"]
    assert missing(components()["averaging"], replace(x, total_field=constant)) == []


def test_a_thermometer_is_known_by_its_units_too() -> None:
    component = components()["temperature_offset"]
    x = example_survey(component)
    board = replace(x, logged={"board": x.channel("temperature")}, units={"board": "K"})
    assert missing(component, board) == []
    assert set(component.function(board).units) == {"nT/K"}


def test_a_channel_must_be_named_where_several_fit() -> None:
    from magtensor.errors import DataError

    x = example_survey(components()["temperature_offset"])
    series = x.channel("temperature")
    names = ("temperature_a", "temperature_b")
    two = replace(x, logged=dict.fromkeys(names, series), units=dict.fromkeys(names, "degC"))
    with pytest.raises(DataError, match="2 channels fit 'temperature\\*': temperature_a, temperature_b"):
        magtensor_effects.temperature_offset(two)
    with pytest.raises(DataError, match="no channel 'temperatur_a' \\(did you mean temperature_a"):
        magtensor_effects.temperature_offset(two, channel="temperatur_a")
    assert magtensor_effects.temperature_offset(two, channel="temperature_b").count == 12


def test_a_temperature_of_each_sensor_reaches_that_sensor() -> None:
    x = example_survey(components()["temperature_offset"])
    each = np.random.default_rng(1).standard_normal((len(x.time), 4))
    own = replace(x, logged={"temperature": each}, units={"temperature": "degC"})
    terms = magtensor_effects.temperature_offset(own)
    for term, sensor in enumerate(np.repeat(range(4), 3)):
        added = terms.contribution(np.eye(12)[term], 12)
        np.testing.assert_array_equal(added[:, term], each[:, sensor])
        assert not np.delete(added, term, axis=1).any()


def test_regressors_take_no_noise_from_the_raw_data() -> None:
    # they may look at the modelled outputs only: Excitation does not hold the recorded ones
    from dataclasses import fields

    from magtensor.error_models.excitation import Excitation

    assert not {"raw", "b_raw"} & {f.name for f in fields(Excitation)}


@error_model("instrument", source="nowhere", typical="1 nT")
def backwards(x):
    """An error model that acts on the reference though it is of the instrument, and is random."""
    return x.on_reference(np.random.default_rng().standard_normal(len(x.time)), "", "noise")


@error_model("reference")
def of_sensors(x):
    return x.offsets(x.elapsed, "nT")


@error_model("instrument", source="nowhere", typical="1 nT")
def repeated(x):
    """The same regressor twice."""
    from magtensor.error_models.terms import joined

    return joined([x.offsets(x.elapsed, "nT/s"), x.offsets(2 * x.elapsed, "nT/s", "again ")])


@error_model("instrument", source="nowhere", typical="1 nT")
def destructive(x):
    """It changes the survey it is given."""
    x.output[...] = 0.0
    return x.offsets(x.elapsed, "nT/s")


@error_model("instrument", needs=("thermometer_reading", "atitude"), source="nowhere", typical="1 nT")
def in_need(x):
    """A fact misspelled is taken for a channel, which no survey has."""
    return x.offsets(x.channel("thermometer_reading"), "nT")


@error_model("instrument", source="nowhere", typical="1 nT")
def unstable(x):
    """It multiplies the output's rate of change by itself: no fixed point."""
    rate = x.derivative(x.derivative(x.derivative(x.output)))
    return x.shared(1e6 * rate / np.abs(rate).max() * np.sin(x.output), "nT", "chaos")


@error_model("instrument", source="nowhere", typical="1 nT")
def endless(x):
    """Its regressor is infinite at the start."""
    with np.errstate(divide="ignore"):
        return x.offsets(1.0 / x.elapsed, "nT s")


@error_model("instrument", source="nowhere", typical="1 nT", pointwise=True)
def with_memory(x):
    """It says that it looks at each sample by itself, and does not."""
    return x.responses(x.relaxed(x.output, 10.0), "1")


@error_model("instrument", source="nowhere", typical="1 nT")
def out_of_range(x, *, tau_s: Annotated[float, Range(1.0, 10.0)] = 20.0):
    """A setting whose default is outside its range."""
    return x.offsets(np.exp(-x.elapsed / tau_s), "nT")


@error_model("instrument", needs=("charge_flow",), source="a diode", typical="1 nT")
def one_way(
    x,
    *,
    threshold: Annotated[float, Range(-8.0, 1e6, count=5, spacing="linear"), Field(description="C/s")] = 0.0,
):
    """A current that flows one way, from a threshold on: with the largest of them never."""
    return x.offsets(np.maximum(x.channel("charge_flow") - threshold, 0.0), "nT/(C/s)")


@error_model("instrument", needs=("charge_flow",), source="nowhere", typical="1 nT")
def never(x, *, threshold: Annotated[float, Range(1e5, 1e6), Field(description="C/s")] = 1e5):
    """A threshold that nothing ever reaches."""
    return x.offsets(np.maximum(x.channel("charge_flow") - threshold, 0.0), "nT/(C/s)")


def test_a_threshold_beyond_the_channel_is_no_fault() -> None:
    assert check_error_model(one_way) == []


@pytest.mark.parametrize(
    ("candidate", "told"),
    [
        (never, ["zero throughout, with whatever settings"]),
        (backwards, ["called again", "no units", "kind instrument but acts on the reference"]),
        (endless, ["not all finite"]),
        (out_of_range, ["tau_s: the default 20.0 is not between 1.0 and 10.0", "tau_s has no description"]),
        (in_need, ["needs 'atitude'", "did you mean attitude?"]),
        (of_sensors, ["no docstring", "no source", "no typical", "of the reference but acts on the sensors"]),
        (repeated, ["linearly dependent: rank 12"]),
        (destructive, ["read-only"]),
        (with_memory, ["marked pointwise"]),
        (unstable, ["distorted and corrected again"]),
        (lambda x: x, ["not marked"]),
    ],
)
def test_the_checker_tells_what_is_wrong(candidate: object, told: list[str]) -> None:
    found = "\n".join(check_error_model(candidate))
    for words in told:
        assert words in found


def test_the_checker_wants_a_function_that_pickles() -> None:
    @error_model("instrument", source="nowhere", typical="1 nT")
    def local(x):
        """Defined inside a function."""
        return x.offsets(x.elapsed, "nT/s")

    assert any("pickled" in line for line in check_error_model(local))
