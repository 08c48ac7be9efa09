"""Settings that several error models share: forms of a response, and what it began with."""

from typing import Annotated

from pydantic import Field

from magtensor.error_models.settings import AsAWhole, Beginning, Bends, Cleaned, Forms

Delayed = Annotated[
    bool,
    AsAWhole(),
    Field(description="true: later than the channel by lag_s, unchanged; false: behind it with a time constant lag_s"),
]

Smooth = Annotated[
    bool,
    Cleaned((False, True)),
    Field(
        description="true: without the noise of the channel's log, as far as its smooth course tells; false: as logged"
    ),
]

AtStart = Annotated[
    float,
    Beginning(),
    Field(description="by how much the lagged channel exceeded its first reading when the survey began"),
]

OfField = Annotated[
    bool,
    Forms((False, True)),
    Field(description="true: acts on what the axis makes of the field; false: on its whole output, offset and all"),
]

BENDS = Field(
    description="values of the channel, less its mean over the calibration survey unless it is a current, at which the "
    "response bends, straight in between; none: by its powers"
)

Bent = Annotated[tuple[float, ...], Bends(), BENDS]
BentPower = Annotated[tuple[float, ...], Bends(instead=("power", "lower_powers")), BENDS]
BentOrder = Annotated[tuple[float, ...], Bends(instead=("order",)), BENDS]
BentOutput = Annotated[
    tuple[float, ...],
    Bends(),
    Field(description="outputs of an axis, nT, at which its transfer curve bends besides; none: the power alone"),
]
