"""What a user did wrong, as exceptions that carry their exit status.

Anything else that escapes is a bug and keeps its traceback (exit status 1).
"""

from __future__ import annotations

from collections.abc import Iterable


class MagtensorError(Exception):
    """A mistake that one message can explain: where it is, what is wrong, what would be right."""

    exit_status = 1


class UsageError(MagtensorError):
    """The command line, a recipe, a scenario or a plugin is wrong."""

    exit_status = 2


class DataError(MagtensorError):
    """The data are wrong, or not enough for what was asked.

    `where` names the file, dataset, channel and time as far as they are known; `hint` says what would be right.
    """

    exit_status = 3

    def __init__(self, what: str, *, where: str = "", hint: str = "") -> None:
        self.what, self.where, self.hint = what, where, hint
        super().__init__(what, where, hint)  # all three in args: an exception must survive pickling

    def __reduce__(self) -> tuple[object, ...]:
        return (_rebuild_data_error, (type(self), self.what, self.where, self.hint))

    def __str__(self) -> str:
        head = f"{self.where}: {self.what}" if self.where else self.what
        return f"{head}\n  {self.hint}" if self.hint else head


def _rebuild_data_error(kind: type[DataError], what: str, where: str, hint: str) -> DataError:
    return kind(what, where=where, hint=hint)


class NotEnoughData(DataError):
    """The data cannot determine what was asked: too few attitudes, a planar rotation, a geometry without depth."""


class MissingAttitudes(NotEnoughData):
    """The field was not turned enough: `magtensor inspect --attitudes` draws what is missing."""


class BatchFailed(MagtensorError):
    """Some surveys of a batch failed; the others are done."""

    exit_status = 4


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`' (did you mean chi2017?)'`, or nothing when no known word is near."""
    import difflib

    near = difflib.get_close_matches(word, list(known), n=3, cutoff=0.55)
    return f" (did you mean {' or '.join(near)}?)" if near else ""
