"""Height from air pressure, and the main field's decrease with height."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

EARTH_RADIUS_M = 6_371_200.0  # the reference radius of geomagnetic field models
# U.S. Standard Atmosphere 1976: gravity, molar mass, gas constant, radius for geopotential height.
_G0, _MOLAR_MASS, _GAS, _RADIUS_M = 9.80665, 0.0289644, 8.31432, 6_356_766.0
_BASE_M = (0.0, 11_000.0, 20_000.0, 32_000.0, 47_000.0)
_LAPSE = (-6.5e-3, 0.0, 1.0e-3, 2.8e-3)  # K per m of geopotential height
_SEA_LEVEL_K, _SEA_LEVEL_PA = 288.15, 101_325.0


def _layers() -> tuple[list[float], list[float]]:
    """Temperature and pressure at the base of each layer, and at the top."""
    temperatures, pressures = [_SEA_LEVEL_K], [_SEA_LEVEL_PA]
    for i, lapse in enumerate(_LAPSE):
        thickness, t = _BASE_M[i + 1] - _BASE_M[i], temperatures[-1]
        top = t + lapse * thickness
        if lapse:
            ratio = (top / t) ** (-_G0 * _MOLAR_MASS / (_GAS * lapse))
        else:
            ratio = np.exp(-_G0 * _MOLAR_MASS * thickness / (_GAS * t))
        temperatures.append(top)
        pressures.append(pressures[-1] * float(ratio))
    return temperatures, pressures


def pressure_height(pressure_Pa: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height above sea level (N,) m from pressure (N,) Pa, by the U.S. Standard Atmosphere 1976.

    NaN above 47 km, where this part of the standard ends, and for pressures that are not positive. Weather makes
    the true height differ by some 100 m; a dipole's field changes by 0.025 nT for each m of height at 50 000 nT.
    """
    temperatures, pressures = _layers()
    pressure = np.where(pressure_Pa > 0, pressure_Pa, np.nan)
    geopotential = np.full(pressure.shape, np.nan)
    for i, lapse in enumerate(_LAPSE):
        inside = pressure >= pressures[i + 1]
        inside &= pressure < pressures[i] if i else True
        ratio = pressure[inside] / pressures[i]
        if lapse:
            rise = temperatures[i] / lapse * (ratio ** (-_GAS * lapse / (_G0 * _MOLAR_MASS)) - 1.0)
        else:
            rise = -_GAS * temperatures[i] / (_G0 * _MOLAR_MASS) * np.log(ratio)
        geopotential[inside] = _BASE_M[i] + rise
    return _RADIUS_M * geopotential / (_RADIUS_M - geopotential)


def dipole_decrease(
    field: float, height_m: NDArray[np.float64], reference_height_m: float = 0.0
) -> NDArray[np.float64]:
    """Total field at a height: `field` ((R + h0) / (R + h))^3, in the units of `field`.

    Args:
        field: total field at the height h0.
        height_m: (N,) height h above sea level, m.
        reference_height_m: h0, m.
    """
    return field * ((EARTH_RADIUS_M + reference_height_m) / (EARTH_RADIUS_M + height_m)) ** 3
