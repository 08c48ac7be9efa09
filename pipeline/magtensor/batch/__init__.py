"""One recipe over many surveys: each in a process of its own, what is done already not done again."""

from magtensor.batch.campaign import Summary, run_batch

__all__ = ["Summary", "run_batch"]
