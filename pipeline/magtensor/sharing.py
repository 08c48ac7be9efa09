"""Work shared out among the cores of this machine.

The processes are forked for it, so that they know everything that this one does, whatever it is; only what they find is
sent back. What is found does not depend on how many there are.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from magtensor.errors import UsageError

PROCESSES = "MAGTENSOR_PROCESSES"  # of the environment; one process where it is not set
END_WITH_PARENT = 1  # PR_SET_PDEATHSIG of prctl(2)

Item = TypeVar("Item")
Found = TypeVar("Found")

_shared: tuple[Callable[[Any], Any], Sequence[Any]] | None = None


def cores() -> int:
    """How many this process may use."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return allowed or 1


def shared_out(work: Callable[[Item], Found], items: Sequence[Item]) -> list[Found]:
    """What a function finds of each item, in their order.

    Parameters
    ----------
    work: any function, of any items; what it finds must survive pickling, and what it changes nobody sees.

    Raises
    ------
    UsageError: the variable of the environment is no number of processes.
    """
    global _shared
    processes = min(_wanted(), len(items))
    if processes < 2 or _shared is not None or not hasattr(os, "fork"):
        return [work(item) for item in items]
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    _shared = work, items
    try:
        with ProcessPoolExecutor(
            processes, mp_context=get_context("fork"), initializer=_begin, initargs=(os.getpid(),)
        ) as pool:
            return list(pool.map(_of_number, range(len(items))))
    finally:
        _shared = None


def _wanted() -> int:
    wanted = os.environ.get(PROCESSES, "1")
    if not (wanted.isascii() and wanted.isdigit() and int(wanted) > 0):
        raise UsageError(f"{PROCESSES}={wanted}: a whole number of processes from 1 on would be right")
    return int(wanted)


def _begin(parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C at the terminal is for the process that shares out
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if sys.platform == "linux":  # elsewhere they wait for a process that was killed
        import ctypes

        ctypes.CDLL(None).prctl(END_WITH_PARENT, signal.SIGTERM)
        if os.getppid() != parent:  # it ended before
            os._exit(1)


def _of_number(number: int) -> Any:
    assert _shared is not None
    work, items = _shared
    return work(items[number])
