"""Built-in QC metrics."""

from magtensor_metrics.disturbance import noise_level, outliers
from magtensor_metrics.fit import closure, contrast, determined, flagged, total_field
from magtensor_metrics.frame import common_rotation
from magtensor_metrics.refinement import refinement

__all__ = [
    "closure", "common_rotation", "contrast", "determined", "flagged", "noise_level", "outliers", "refinement",
    "total_field",
]  # fmt: skip
