"""Error models of a sensor's transfer curve: nonlinearity, transverse field, hysteresis."""

from typing import Annotated

import numpy as np
from pydantic import Field

from magtensor.calibration.types import Array
from magtensor.components import error_model
from magtensor.error_models.curves import along_a_curve
from magtensor.error_models.excitation import Excitation
from magtensor.error_models.settings import Orders, Plays
from magtensor.error_models.terms import Terms, joined
from magtensor_effects.forms import BentOutput, OfField

FULL_SCALE_NT = 50000.0  # at which the coefficients of nonlinear terms are stated
AT_FULL_SCALE = "nT at 50000 nT"


@error_model(
    "instrument",
    source="Olsen et al. 2020 (CryoSat-2)",
    typical="1 nT at 50 000 nT; CryoSat-2 3.2 nT with the cubic",
    pointwise=True,
)
def nonlinearity_quadratic(x: Excitation, *, bends: BentOutput = ()) -> Terms:
    """A second-order term in each axis's transfer curve: (m / 50 000 nT) squared.

    The coefficient is what it adds at 50 000 nT. Rival: `cross_field`, which nearly contains it where the total
    field is constant; offset and scale themselves where an axis never changes sign. Where a curve with `bends` predicts
    better, as of a gain that differs for either sign, each of these has a coefficient: what it adds 50 000 nT beyond.
    """
    return _transfer_curve(x, x.output, 2, bends)


@error_model("instrument", source="Olsen et al. 2020 (CryoSat-2)", typical="1 nT at 50 000 nT", pointwise=True)
def nonlinearity_cubic(x: Excitation, *, of_field: OfField = False, bends: BentOutput = ()) -> Terms:
    """A third-order term in each axis's transfer curve: (m / 50 000 nT) cubed.

    The coefficient is what it adds at 50 000 nT. In a constant total field F an answer m (F^2 - m^2) to the field
    across the axis is the same thing with the other sign but for a scale factor; no survey in the Earth's field
    alone tells the two apart, and this name stands for both. `bends` as of `nonlinearity_quadratic`: an amplifier that
    saturates.
    """
    return _transfer_curve(x, x.driving(of_field), 3, bends)


def _transfer_curve(x: Excitation, driving: Array, power: int, bends: tuple[float, ...]) -> Terms:
    """A power of what drives each axis (N, S, 3) nT, and how far that is beyond each of the bends."""
    beyond = along_a_curve(driving, bends)[1:]
    smooth = x.responses((driving / FULL_SCALE_NT) ** power, AT_FULL_SCALE)
    return joined([smooth, *(x.responses(c / FULL_SCALE_NT, AT_FULL_SCALE, label) for label, c in beyond)])


@error_model(
    "instrument",
    source="transverse sensitivity of uncompensated fluxgates",
    typical="1 to 20 nT without vector compensation",
    pointwise=True,
)
def cross_field(x: Excitation) -> Terms:
    """Each axis answers to the field across it: to the product of the two transverse outputs and to the
    difference of their squares.

    Two coefficients an axis, each what it adds where the transverse outputs are 50 000 nT. The third term of the
    same order, the axis's output times the square of the transverse field, is `nonlinearity_cubic`. Rival:
    `nonlinearity_quadratic`.
    """
    m = x.output / FULL_SCALE_NT
    one, other = np.roll(m, -1, axis=2), np.roll(m, -2, axis=2)
    return joined(
        [
            x.responses(one * other, AT_FULL_SCALE, "product "),
            x.responses(one**2 - other**2, AT_FULL_SCALE, "difference "),
        ]
    )


@error_model(
    "instrument",
    needs=("turning",),
    source="play operator of Prandtl and Ishlinskii",
    typical="below 2 nT after twice the full scale",
)
def hysteresis(
    x: Excitation,
    *,
    half_width_nT: Annotated[
        float,
        Plays(300.0, 30000.0, count=6, spacing="log"),
        Field(gt=0, description="half width of the play: how far the field turns back before the output follows, nT"),
    ] = 5000.0,
    of_iron: Annotated[
        bool,
        Orders((False, True)),
        Field(description="true: iron beside the sensor, whose field reaches all axes; false: each axis by itself"),
    ] = False,
) -> Terms:
    """Part of each axis's output, or of what iron beside the sensor adds to it, hangs behind like gears with play.

    (P_r(m) - m) / r with the play operator P_r run along all samples, and along the points between them at which the
    output turns back; the coefficient is half the opening of the loop. The magnetisation of iron along one axis shows
    in all three: nine coefficients a sensor then, through a matrix. It starts without play at the first sample and
    keeps its state across gaps. Rivals: `sampling_lag` and `eddy_current` for swings of equal amplitude and rate, and
    `viscous_magnetisation` for iron.
    """
    m = x.output.reshape(len(x.time), -1)
    course = x.with_turning_points.reshape(-1, m.shape[1])
    hanging = (_play(course, half_width_nT)[::2] - m) / half_width_nT
    hanging = hanging.reshape(x.output.shape)
    return x.matrices(hanging, "nT") if of_iron else x.responses(hanging, "nT")


def _play(u: Array, half_width: float) -> Array:
    """The play operator p[k] = clip(p[k - 1], u[k] - r, u[k] + r) from p = u[0], for columns of (N, K).

    A clip after a clip is a clip, so the samples are taken in about sqrt(N) stretches: first the one clip that each
    beginning of a stretch amounts to, for all stretches at once, then the state from stretch to stretch.
    """
    n = len(u)
    length = max(1, int(np.sqrt(n)))
    padded = np.concatenate([u, np.repeat(u[-1:], -n % length, axis=0)]).reshape(-1, length, u.shape[1])
    low, high = padded - half_width, padded + half_width
    for i in range(1, length):
        own_low, own_high = low[:, i].copy(), high[:, i].copy()
        low[:, i] = np.minimum(np.maximum(low[:, i - 1], own_low), own_high)
        high[:, i] = np.minimum(np.maximum(high[:, i - 1], own_low), own_high)
    state = u[0]
    out = np.empty_like(padded)
    for stretch in range(len(padded)):
        out[stretch] = np.minimum(np.maximum(state, low[stretch]), high[stretch])
        state = out[stretch, -1]
    return out.reshape(-1, u.shape[1])[:n]
