"""Simulate a survey: the physics in the time domain, independent of every regressor the calibration fits.

from magtensor.simulate import simulate, write
write(simulate("recipes/scenarios/demo.yaml"), "survey.h5")
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magtensor.simulate.output import write
    from magtensor.simulate.run import Simulated, simulate
    from magtensor.simulate.scenario import Scenario, read_scenario

_LAZY = {
    "Scenario": "magtensor.simulate.scenario",
    "Simulated": "magtensor.simulate.run",
    "read_scenario": "magtensor.simulate.scenario",
    "simulate": "magtensor.simulate.run",
    "write": "magtensor.simulate.output",
}
__all__ = ["Scenario", "Simulated", "read_scenario", "simulate", "write"]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'magtensor.simulate' has no attribute {name!r}")
