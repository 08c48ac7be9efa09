"""One survey in a process of its own: whatever happens to it there, the batch goes on."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time as clock
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from magtensor.recipe.source import Document
from magtensor.sharing import PROCESSES

ERROR_FILE = "error.txt"
GRACE_S = 5.0  # between asking a process to end and ending it
KINDS = {1: "bug", 2: "recipe", 3: "data"}
# One thread each: the processes share the cores, and sums must not depend on how many threads made them.
THREADS = (
    "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)  # fmt: skip


@dataclass(frozen=True)
class Task:
    """A survey to run.

    Attributes:
        survey: absolute path.
        folder: where its files go; absolute.
        document: the recipe as read once for the whole batch, `--set` applied.
        plugin_folders: absolute.
    """

    survey: Path
    folder: Path
    document: Document
    plugin_folders: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """How it ended: the exit status of `run` (above 128: the signal that ended the process), and the words."""

    exit_status: int
    message: str
    seconds: float

    @property
    def kind(self) -> str:
        """`data`, `recipe`, `bug` or `killed`; nothing for success."""
        if self.exit_status == 0:
            return ""
        return "killed" if self.exit_status > 128 else KINDS.get(self.exit_status, "bug")


class Processes:
    """Starts one process per survey, and can end all that run."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._stopped = False

    def run(self, task: Task) -> Outcome:
        """Run the task in a new process and wait for it; never raises for what the task does."""
        begin = clock.perf_counter()
        errors = task.folder / ERROR_FILE
        try:
            task.folder.mkdir(parents=True, exist_ok=True)
            stderr = open(errors, "wb")  # noqa: SIM115
        except OSError as error:
            return Outcome(2, f"{task.folder}: cannot be written: {error.strerror or error}", 0.0)
        with stderr:
            outcome = self._run(task, stderr.fileno())
        outcome = Outcome(outcome.exit_status, outcome.message, clock.perf_counter() - begin)
        _tidy(errors, outcome)
        if outcome.exit_status:
            with suppress(OSError):  # it holds what this or an earlier run left
                task.folder.rmdir()
        return outcome

    def _run(self, task: Task, stderr: int) -> Outcome:
        with self._lock:
            if self._stopped:
                return Outcome(128 + signal.SIGTERM, "stopped before it began", 0.0)
            process = self._start(stderr)
            self._running.add(process)
        try:
            return _conversation(process, task) or _ended(process.returncode)
        finally:
            with self._lock:
                self._running.discard(process)

    def _start(self, stderr: int) -> subprocess.Popen[bytes]:
        environment = {**dict.fromkeys(THREADS, "1"), **os.environ, PROCESSES: "1"}
        return subprocess.Popen(
            [sys.executable, "-P", "-X", "faulthandler", "-m", "magtensor.batch.worker"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, env=environment,
            start_new_session=True,  # Ctrl-C at the terminal is for the batch, which ends its processes itself
        )  # fmt: skip

    def stop(self) -> None:
        """End every process: asked first, so that half-written files are removed, then by force."""
        with self._lock:
            self._stopped = True
            running = list(self._running)
        for process in running:
            process.terminate()
        deadline = clock.monotonic() + GRACE_S
        for process in running:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, deadline - clock.monotonic()))
        for process in running:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)  # and what a plugin may have started


def run_isolated(task: Task) -> Outcome:
    """Run one task in a process of its own, from wherever this is called."""
    return Processes().run(task)


def _conversation(process: subprocess.Popen[bytes], task: Task) -> Outcome | None:
    """Hand over the task and wait for the outcome; None if the process ended without one.

    Its standard input stays open as long as this process lives: where it closes, the worker ends itself.
    """
    assert process.stdin is not None and process.stdout is not None
    with process.stdout, suppress(BrokenPipeError):
        try:
            with suppress(BrokenPipeError):
                process.stdin.write(pickle.dumps(task))
                process.stdin.flush()
            answer = process.stdout.read()
        finally:
            with suppress(BrokenPipeError):
                process.stdin.close()
    process.wait()
    try:
        outcome = pickle.loads(answer)
    except Exception:  # nothing, or the half of one
        return None
    return outcome if isinstance(outcome, Outcome) else None


def _ended(status: int) -> Outcome:
    """A process that ended without a word."""
    if status >= 0:
        return Outcome(1, f"its process ended with status {status} without a word", 0.0)
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = f"signal {-status}"
    likely = {
        "SIGKILL": " (out of memory, or ended by hand)",
        "SIGSEGV": " (a crash in compiled code)",
        "SIGTERM": " (ended by hand)",
    }
    return Outcome(128 - status, f"its process was ended by {name}{likely.get(name, '')}", 0.0)


def _tidy(errors: Path, outcome: Outcome) -> None:
    """What the process printed: kept where something broke, else passed on."""
    text = errors.read_text(encoding="utf-8", errors="replace")
    if text and outcome.kind in ("bug", "killed"):
        return
    errors.unlink()
    if text:
        sys.stderr.write("".join(f"{errors.parent.name}: {line}\n" for line in text.splitlines()))
