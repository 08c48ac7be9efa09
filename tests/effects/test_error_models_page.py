"""The page of error models says what the error models say."""

from __future__ import annotations

import importlib.util
from pathlib import Path

WRITER = Path(__file__).parents[2] / "docs" / "write_error_models.py"


def test_the_page_is_up_to_date() -> None:
    spec = importlib.util.spec_from_file_location("write_error_models", WRITER)
    assert spec is not None and spec.loader is not None
    writer = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(writer)
    assert writer.PAGE.read_text(encoding="utf-8") == writer.page(), f"run python {WRITER.name} in docs/"
