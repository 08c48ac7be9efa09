"""Where the surveys of a batch run: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any, Protocol

from magtensor.batch.process import Outcome, Processes, Task, run_isolated
from magtensor.errors import UsageError
from magtensor.sharing import cores

CONNECT_S = 10


class Runner(Protocol):
    """Runs tasks; each gives exactly one outcome, and none takes another with it."""

    def run(self, tasks: Iterable[Task]) -> Generator[tuple[Task, Outcome]]:
        """Yield each task with its outcome as it ends; a task is drawn from `tasks` only when it can begin.

        Closing the iterator ends what still runs.
        """
        ...


class LocalRunner:
    """At most `workers` processes of this machine at once; default: one per core this process may use."""

    def __init__(self, workers: int | None = None) -> None:
        self.workers = workers or cores()

    def run(self, tasks: Iterable[Task]) -> Generator[tuple[Task, Outcome]]:
        """As `Runner.run`."""
        processes = Processes()
        pool = ThreadPoolExecutor(self.workers)
        running: dict[Future[Outcome], Task] = {}
        try:
            for task in tasks:
                running[pool.submit(processes.run, task)] = task
                if len(running) == self.workers:
                    yield from _ended(running)
            while running:
                yield from _ended(running)
        finally:
            processes.stop()
            pool.shutdown()


def _ended(running: dict[Future[Outcome], Task]) -> Iterator[tuple[Task, Outcome]]:
    for future in wait(running, return_when=FIRST_COMPLETED).done:
        yield running.pop(future), future.result()


class DaskRunner:
    """The workers of a Dask scheduler, which see the same files under the same paths.

    Each survey has a process of its own there too, so that one that is killed does not take the worker with it.

    Raises:
        UsageError: dask is not installed, or no scheduler answers.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError as error:
            raise UsageError("--scheduler needs the package distributed: pip install 'magtensor[dask]'") from error
        try:
            self._client: Any = Client(address, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise UsageError(f"--scheduler {address}: no Dask scheduler answers there: {error}") from error

    def run(self, tasks: Iterable[Task]) -> Generator[tuple[Task, Outcome]]:
        """As `Runner.run`, but every task is handed to the scheduler at once."""
        from distributed import as_completed

        waiting: dict[Any, Task] = {}
        try:
            for task in tasks:
                waiting[self._client.submit(run_isolated, task, pure=False)] = task
            for future in as_completed(list(waiting)):
                if future.status == "finished":
                    outcome = future.result()
                else:
                    outcome = Outcome(1, f"its Dask worker failed: {future.exception()!r}", 0.0)
                yield waiting.pop(future), outcome
        finally:
            self._client.cancel(list(waiting))
            self._client.close()
