"""Work is shared out among forked processes, and what they find does not depend on how many there are."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest

from magtensor.errors import DataError, UsageError
from magtensor.sharing import PROCESSES, shared_out


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Two processes, however many cores there are."""
    monkeypatch.setenv(PROCESSES, "2")
    yield


def test_results_keep_their_order_and_come_from_other_processes(two: None) -> None:
    big = np.arange(10.0)  # not an argument: the processes know it

    found = shared_out(lambda k: (k, float(big[k] ** 2), os.getpid()), range(8))

    assert [f[:2] for f in found] == [(k, float(k * k)) for k in range(8)]
    assert os.getpid() not in {f[2] for f in found}


def test_without_the_variable_nothing_is_forked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PROCESSES)

    assert shared_out(lambda _: os.getpid(), range(3)) == [os.getpid()] * 3


def test_what_is_shared_out_shares_out_nothing_itself(two: None) -> None:
    found = shared_out(lambda _: [os.getpid(), *shared_out(lambda _: os.getpid(), range(3))], range(4))

    assert all(len(set(each)) == 1 for each in found)


def test_an_error_comes_back_as_it_was_raised(two: None) -> None:
    def refuse(k: int) -> int:
        if k == 2:
            raise DataError("too few", where="survey.h5", hint="more would do")
        return k

    with pytest.raises(DataError, match="too few") as caught:
        shared_out(refuse, range(4))

    assert (caught.value.where, caught.value.hint) == ("survey.h5", "more would do")
    assert shared_out(lambda k: k, range(3)) == [0, 1, 2]  # and the next work is not in its way


@pytest.mark.parametrize("wanted", ["0", "two", "-1", ""])
def test_a_number_of_processes_that_is_none_is_refused(wanted: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PROCESSES, wanted)

    with pytest.raises(UsageError, match=f"{PROCESSES}={wanted}: a whole number"):
        shared_out(lambda k: k, range(3))


BUSY = """
import os, time
from magtensor.sharing import shared_out
shared_out(lambda _: (os.write(1, b"%d\\n" % os.getpid()), time.sleep(60)), range(2))
"""


def alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    with open(f"/proc/{process}/stat") as stat:
        return stat.read().rpartition(")")[2].split()[0] != "Z"  # what nobody has waited for is no more


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process that its parent has ended")
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_they_end_with_the_process_that_shares_out(how: signal.Signals) -> None:
    environment = os.environ | {PROCESSES: "2"}
    with subprocess.Popen([sys.executable, "-c", BUSY], stdout=subprocess.PIPE, text=True, env=environment) as run:
        assert run.stdout is not None
        workers = [int(run.stdout.readline()) for _ in range(2)]
        assert all(alive(worker) for worker in workers)
        run.send_signal(how)
        run.wait(10)
        for _ in range(100):
            if not any(alive(worker) for worker in workers):
                break
            time.sleep(0.05)
    assert not any(alive(worker) for worker in workers)
