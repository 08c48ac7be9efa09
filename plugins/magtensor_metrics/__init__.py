"""Built-in QC metrics."""

from magtensor_metrics.fit import closure, contrast, flagged, total_field

__all__ = ["closure", "contrast", "flagged", "total_field"]
