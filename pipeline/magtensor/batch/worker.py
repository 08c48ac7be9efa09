"""The process that runs one survey: a task comes in on standard input, its outcome goes out on standard output."""

from __future__ import annotations

import os
import pickle
import shutil
import signal
import sys
import threading
import traceback
from types import FrameType
from typing import NoReturn

from magtensor.batch.process import Outcome, Task
from magtensor.errors import MagtensorError


class Stop(BaseException):
    """The batch asks this process to end; not an Exception, so that no plugin takes it for a failure of its own."""


def outcome_of(task: Task) -> Outcome:
    """Run the task here; a bug's traceback goes to standard error."""
    from magtensor.recipe.plan import plan
    from magtensor.refusal import picture_named
    from magtensor.session import run_plan

    try:
        planned = plan(task.document, plugin_folders=task.plugin_folders, survey=task.survey)
        with picture_named(task.document.file, survey=task.survey, plugin_folders=task.plugin_folders):
            finished = run_plan(planned, task.folder)
    except MagtensorError as error:
        return Outcome(error.exit_status, str(error), 0.0)
    except Stop:
        raise
    except BaseException as error:
        traceback.print_exc()
        return Outcome(1, f"{type(error).__name__}: {error}".strip(": "), 0.0)
    return Outcome(0, finished.sentence, 0.0)


def main() -> None:
    """Serve one task."""
    signal.signal(signal.SIGTERM, _stop)
    # prints of plugins and libraries go with the errors: standard output is for the outcome alone
    answer = os.dup(1)
    os.dup2(2, 1)
    task: Task = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    for leftover in task.folder.glob(".partial-*"):  # of a process that was killed; nobody else writes here
        shutil.rmtree(leftover, ignore_errors=True)
    outcome = outcome_of(task)
    sys.stdout.flush()
    with os.fdopen(answer, "wb") as stream:
        stream.write(pickle.dumps(outcome))


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    raise Stop


def _end_with_parent() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)


if __name__ == "__main__":
    try:
        main()
    except Stop:
        sys.exit(128 + signal.SIGTERM)
