"""One self-contained HTML page about a finished run, made from `result.nc` and `verdict.json` alone."""

from magtensor.report.page import write_report

__all__ = ["write_report"]
