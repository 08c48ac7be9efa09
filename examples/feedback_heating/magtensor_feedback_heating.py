"""An error model of one's own: the current that cancels the field heats the electronics."""

from typing import Annotated

from pydantic import Field

from magtensor.components import error_model
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import Range
from magtensor.error_models.terms import Terms


@error_model("instrument", source="an example", typical="0.1 nT where the field stays along one axis for minutes")
def feedback_heating(
    x: Excitation,
    *,
    tau_s: Annotated[
        float, Range(5.0, 500.0, count=6, spacing="log"), Field(gt=0, description="thermal time constant, s")
    ] = 60.0,
) -> Terms:
    """Each axis's offset follows the heat of its own feedback current, which grows as the square of its output.

    The square of the output at 50 000 nT as unit, through a first-order lag: the coefficient is the offset after a
    long time at 50 000 nT. Rival: `nonlinearity_quadratic`, which is this without the lag.
    """
    heat = (x.output / 50000.0) ** 2
    return x.responses(x.lagged(heat, tau_s), "nT at 50000 nT")
