"""`batch.json`: what happened to each survey, written anew after every one."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

from magtensor.atomic import write_text
from magtensor.errors import UsageError

NAME = "batch.json"
LOCK = ".batch.lock"
SCHEMA = 1
State = Literal["waiting", "running", "done", "failed", "stopped"]


@dataclass(frozen=True)
class Entry:
    """One survey of a batch.

    Attributes:
        survey: absolute path.
        folder: the name of its folder in the output folder.
        state: `stopped` was running when the batch was stopped.
        why: why it was (or is to be) run: `no result yet`, `recipe changed: ...`, `input changed: ...`, ...
        exit_status: as of the command `run`; above 128 a signal ended the process; None before it ended.
        seconds: how long it ran.
        finished: when, ISO 8601 UTC.
        message: the verdict in one sentence, or what went wrong.
    """

    survey: str
    folder: str
    state: State
    why: str = ""
    exit_status: int | None = None
    seconds: float | None = None
    finished: str = ""
    message: str = ""


class Ledger:
    """The entries of `batch.json`, in the order in which the surveys were first asked for."""

    def __init__(self, output: Path, recipe: str) -> None:
        self.path = output / NAME
        self.recipe = recipe
        self.entries: dict[str, Entry] = {}
        self.damage = ""
        self._load()

    def _load(self) -> None:
        try:
            stored = json.loads(self.path.read_text(encoding="utf-8"))
            known = {f.name for f in fields(Entry)}
            entries = [Entry(**{k: v for k, v in one.items() if k in known}) for one in stored["surveys"]]
        except FileNotFoundError:
            return
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            self.damage = f"{self.path}: cannot be read ({type(error).__name__}: {error})"
            return
        self.entries = {e.survey: e for e in entries}

    def put(self, *entries: Entry) -> None:
        """Add or replace entries and write the file."""
        self.entries |= {e.survey: e for e in entries}
        stored = {"schema": SCHEMA, "recipe": self.recipe, "surveys": [asdict(e) for e in self.entries.values()]}
        write_text(self.path, json.dumps(stored, indent=1) + "\n")


@contextmanager
def only_batch(output: Path) -> Iterator[None]:
    """Hold the output folder for this batch; the lock goes with the process, however it ends.

    Raises:
        UsageError: another batch holds it, or the folder cannot be written.
    """
    import fcntl

    try:
        output.mkdir(parents=True, exist_ok=True)
        lock = open(output / LOCK, "w")  # noqa: SIM115 (held for the whole batch)
    except OSError as error:
        raise UsageError(f"{output}: cannot be written: {error.strerror or error}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(f"{output}: another batch is running into this folder") from error
        except OSError:
            pass  # a file system without locks: nothing to hold
        yield
