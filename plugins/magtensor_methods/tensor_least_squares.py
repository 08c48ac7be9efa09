"""Tensor assembly by weighted least squares, for any geometry."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magtensor import method
from magtensor.tensor.assembly import Assembly, least_squares_assembly
from magtensor.tensor.geometry import Order


@method("assemble_tensor", source="symmetric traceless tensor by weighted least squares on solid harmonics")
def least_squares(
    position: NDArray[np.float64],
    noise_covariance: NDArray[np.float64] | None,
    *,
    highest_order: Annotated[
        Order,
        Field(description="highest gradient fitted; more removes finite-baseline error, costs noise"),
    ] = "gradient",
) -> Assembly:
    """Weighted least squares for the field and the five independent tensor components at the array's centre.

    Parameters
    ----------
    position : (S, 3) m in the platform frame.
    noise_covariance : (3 S, 3 S) nT^2 of the calibrated fields, or None for equal weights.

    Raises
    ------
    NotEnoughData : the geometry cannot determine all components; the message names those it cannot.
    """
    return least_squares_assembly(position, noise_covariance, highest_order)
