"""What a refusal says beside what is wrong: the command that shows it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from magtensor.errors import MissingAttitudes


@contextmanager
def picture_named(
    file: str | Path,
    *,
    survey: Path | None = None,
    overrides: Sequence[str] = (),
    plugin_folders: Sequence[Path] = (),
) -> Iterator[None]:
    """Add to a refusal for want of attitudes the command that draws what is missing; as in `draw_attitudes`."""
    try:
        yield
    except MissingAttitudes as error:
        words = ["magtensor", "inspect", str(file), *(["--input", str(survey)] if survey is not None else [])]
        words += [w for text in overrides for w in ("--set", text)]
        words += [w for folder in plugin_folders for w in ("--plugins", str(folder))]
        words += ["--attitudes", f"{Path(survey or file).stem}.attitudes.svg"]
        hint = f"{error.hint}\n  a picture of what is missing: {shlex.join(words)}"
        raise type(error)(error.what, where=error.where, hint=hint) from error
