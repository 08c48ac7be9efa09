"""The effects that a scenario can put into a survey, by their names in the catalogue of error models."""

from typing import Annotated

from pydantic import Field

from magtensor.simulate.effects.electronics import (
    OffsetDrift,
    OffsetStep,
    ScaleDrift,
    ScaleStep,
    SupplyOffset,
    SupplyScale,
    TemperatureOffset,
    TemperatureRate,
    TemperatureScale,
    WarmUp,
)
from magtensor.simulate.effects.geometry import BaselineExpansion, PositionError
from magtensor.simulate.effects.platform import (
    AlignmentDrift,
    CalibrationStep,
    ChannelAlignment,
    ChannelRate,
    ChannelResponse,
    Crosstalk,
    CurrentField,
    EddyCurrent,
    FrameFlexure,
    IronHysteresis,
    LatentSource,
    MovingPart,
    PeriodicInterference,
    TemperatureAlignment,
    TurnStep,
    ViscousMagnetisation,
)
from magtensor.simulate.effects.reference import ReferenceClock, ReferenceDrift, ReferenceScale, ReferenceStep
from magtensor.simulate.effects.sensor import (
    Bandwidth,
    CrossField,
    Hysteresis,
    NonlinearityCubic,
    NonlinearityQuadratic,
)
from magtensor.simulate.effects.site import FixedSource, PassingSource, SiteGradient
from magtensor.simulate.effects.timing import Averaging, ClockDrift, Jitter, LagStep, SamplingLag

AnyEffect = Annotated[
    TemperatureOffset
    | TemperatureScale
    | TemperatureRate
    | OffsetDrift
    | ScaleDrift
    | WarmUp
    | OffsetStep
    | ScaleStep
    | TurnStep
    | CalibrationStep
    | TemperatureAlignment
    | AlignmentDrift
    | ChannelAlignment
    | SupplyScale
    | SupplyOffset
    | CurrentField
    | ChannelResponse
    | ChannelRate
    | LatentSource
    | MovingPart
    | PeriodicInterference
    | Crosstalk
    | EddyCurrent
    | ViscousMagnetisation
    | IronHysteresis
    | FrameFlexure
    | NonlinearityQuadratic
    | NonlinearityCubic
    | CrossField
    | Hysteresis
    | Bandwidth
    | SamplingLag
    | LagStep
    | Averaging
    | ClockDrift
    | Jitter
    | PositionError
    | BaselineExpansion
    | FixedSource
    | SiteGradient
    | PassingSource
    | ReferenceScale
    | ReferenceClock
    | ReferenceDrift
    | ReferenceStep,
    Field(discriminator="type"),
]
