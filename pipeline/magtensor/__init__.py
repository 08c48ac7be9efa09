"""magtensor: calibration of magnetic gradient tensor systems, with the loop closed by measured data."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_LAZY = {
    "stage": "magtensor.components",
    "method": "magtensor.components",
    "reader": "magtensor.components",
    "metric": "magtensor.components",
    "error_model": "magtensor.components",
    "MethodChoice": "magtensor.components",
    "MetricsChoice": "magtensor.components",
    "ErrorModelsChoice": "magtensor.components",
    "DataError": "magtensor.errors",
    "UsageError": "magtensor.errors",
    "NotEnoughData": "magtensor.errors",
    "Calibration": "magtensor.closed_loop",
    "close_loop": "magtensor.closed_loop",
    "explore": "magtensor.explorer",
}
__all__ = [
    "Calibration",
    "DataError",
    "ErrorModelsChoice",
    "MethodChoice",
    "MetricsChoice",
    "NotEnoughData",
    "UsageError",
    "__version__",
    "close_loop",
    "error_model",
    "explore",
    "method",
    "metric",
    "reader",
    "stage",
]

if TYPE_CHECKING:
    from magtensor.closed_loop import Calibration, close_loop
    from magtensor.components import (
        ErrorModelsChoice,
        MethodChoice,
        MetricsChoice,
        error_model,
        method,
        metric,
        reader,
        stage,
    )
    from magtensor.errors import DataError, NotEnoughData, UsageError
    from magtensor.explorer import explore


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'magtensor' has no attribute {name!r}")
