"""Files that are whole or absent: written beside their place, then renamed into it."""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from magtensor.errors import UsageError

PARTIAL = ".partial-"


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path in the same folder; renamed to `path` when the block ends well, removed when not."""
    path = Path(path)
    _make(path.parent)
    begun = f".{path.name}{PARTIAL}"
    _clear(path.parent, begun)
    temporary = path.with_name(begun + _mine())
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        with suppress(FileNotFoundError):
            temporary.unlink()


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def atomic_set(directory: Path, last: str) -> Iterator[Path]:
    """A folder to write a set of files into; moved into `directory` when the block ends well.

    The file called `last` goes first when the old set is taken away and comes last when the new one is put in
    place: where it is present, the set is whole.
    """
    directory = Path(directory)
    _make(directory)
    _clear(directory, PARTIAL)
    partial = directory / (PARTIAL + _mine())
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    try:
        yield partial
        names = sorted((f.name for f in partial.iterdir()), key=lambda name: name == last)
        with suppress(FileNotFoundError):
            (directory / last).unlink()
        for name in names:
            os.replace(partial / name, directory / name)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _mine() -> str:
    """The end of the names that this process uses: of what is half written, who is at it."""
    return f"{platform.node()}-{os.getpid()}"


def _clear(directory: Path, begun: str) -> None:
    """Take away what processes of this machine have left half written that are no more: they were killed.

    A process of another machine that shares the folder may live, whatever its number is here.
    """
    own = f"{begun}{platform.node()}-"
    with suppress(OSError):
        for left in directory.iterdir():
            number = left.name.removeprefix(own)
            if left.name.startswith(own) and number.isdecimal() and not _lives(int(number)):
                shutil.rmtree(left) if left.is_dir() else left.unlink()


def _lives(process: int) -> bool:
    """Whether there is a process of this number; yes where that cannot be asked."""
    if os.name != "posix":  # elsewhere the question would end it
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's, or no number of a process
        return True
    return True


def refuse_overwriting(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """See that nothing is written over what it is made from.

    Raises:
        UsageError: an output is an input.
    """
    read = {p.resolve() for p in inputs}
    for output in outputs:
        if output.resolve() in read:
            raise UsageError(f"{output}: the output would replace this input; name another with --output")


def require_writable(directory: Path) -> None:
    """See that a folder can be written, or made, before hours are spent on what is to go there.

    Raises:
        UsageError: it cannot.
    """
    place = next(p for p in (Path(directory).resolve(), *Path(directory).resolve().parents) if p.exists())
    if not place.is_dir():
        raise UsageError(f"{directory}: cannot be written: {place} is no folder")
    try:
        with tempfile.TemporaryFile(dir=place):  # permissions alone do not tell: a file system may be read-only
            pass
    except OSError as error:
        raise UsageError(f"{directory}: cannot be written: {place} takes no file: {error.strerror or error}") from error


def _make(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{directory}: cannot be written: {error.strerror or error}") from error
