"""An error model of a source that nobody logged."""

from typing import Annotated

from pydantic import Field

from magtensor.components import error_model
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.terms import Terms


@error_model(
    "instrument",
    needs=("waveform",),
    source="factor analysis: Lawley and Maxwell 1971",
    typical="unknown: a heater, a pump, a radio on the platform",
)
def latent_source(
    x: Excitation,
    *,
    noise_nT: Annotated[
        tuple[float, ...], Field(description="white noise of each output, by which another survey's are weighed, nT")
    ] = (),
) -> Terms:
    """A source nobody logged: one waveform common to the sensors, a vector at each.

    The waveform is not a setting: the search finds it in what the sensors share beyond the field, and a correction
    finds each survey's own in the same way, where neither a uniform field nor a gradient could make it. It has unit
    rms in the calibration's survey; one coefficient an axis, what the axis senses then: C times the field at the
    sensor, where a simulated source is given by that field. The part of the vectors that
    is common to all sensors follows from the total field alone. Tried only when no other model explains what is
    left, and never adopted with fewer than three sensors, where it may be a disturbance of one of them. Rivals:
    everything that nobody logged.
    """
    assert x.waveform is not None  # the model needs it
    return x.offsets(x.waveform, "nT")
