"""Built-in QC metrics."""

from magtensor_metrics.disturbance import noise_level, outliers
from magtensor_metrics.fit import closure, contrast, flagged, total_field

__all__ = ["closure", "contrast", "flagged", "noise_level", "outliers", "total_field"]
