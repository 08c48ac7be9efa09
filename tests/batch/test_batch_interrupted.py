"""A batch that is killed, stopped or started twice, each time as a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

PATIENCE_S = 60  # until a test gives up; nothing is measured


def until(condition, what: str):
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if found := condition():
            return found
        time.sleep(0.05)
    raise AssertionError(f"waited in vain for {what}")


def gone(process: int) -> bool:
    try:
        with open(f"/proc/{process}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True


def states(archive) -> dict[str, str]:
    return {name: entry["state"] for name, entry in archive.record().items()}


class Blocked:
    """A batch as a process: two surveys done, two that wait for the file `go`, one not yet begun."""

    def __init__(self, archive) -> None:
        self.archive = archive
        contents = {"a": "1 2", "b": "3 4", "c": "wait 5 6", "d": "wait 7 8", "e": "9"}
        self.surveys = [archive.survey(f"{name}.h5", content) for name, content in contents.items()]
        self.process = self.start()
        until(lambda: len(archive.begun()) == 4, "four surveys to begin")
        self.workers = [process for _, process, _ in archive.begun()]

    def start(self) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "magtensor", *self.archive.arguments(*self.surveys)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def end(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, out, err

    def go_on(self) -> int:
        (self.archive.folder / "go").touch()
        self.archive.forget_runs()
        self.process = self.start()
        return self.end()[0]


@pytest.fixture
def blocked(archive):
    batch = Blocked(archive)
    yield batch
    (archive.folder / "go").touch()  # whatever a failed test left behind ends by itself
    if batch.process.poll() is None:
        batch.process.kill()
    batch.process.communicate()


def test_killed_batch_goes_on_where_it_stopped(blocked, archive):
    blocked.process.kill()
    assert blocked.end()[0] == -signal.SIGKILL
    until(lambda: all(gone(p) for p in blocked.workers), "the workers to follow their batch")
    assert states(archive) == {
        "a.h5": "done", "b.h5": "done", "c.h5": "running", "d.h5": "running", "e.h5": "waiting"
    }  # fmt: skip
    done = {f: f.stat().st_mtime_ns for f in archive.output.rglob("result.nc")}
    assert sorted(f.parent.name for f in done) == ["a", "b"]
    (archive.output / "c" / ".partial-1").mkdir()  # as a worker leaves it that is killed while it writes

    assert blocked.go_on() == 0
    assert archive.runs() == ["c.h5", "d.h5", "e.h5"]
    assert set(states(archive).values()) == {"done"}
    assert all(f.stat().st_mtime_ns == then for f, then in done.items())
    assert not list(archive.output.rglob(".partial-*"))


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.long)]
)
def test_stopped_batch_ends_its_workers_and_goes_on(blocked, archive, number, status):
    until(lambda: list(states(archive).values()).count("done") == 2, "two records")
    blocked.process.send_signal(number)
    code, out, err = blocked.end()
    assert code == status
    assert all(gone(p) for p in blocked.workers), "they end before the batch does"
    assert "stopped after 2 of 5 surveys" in out
    assert "Traceback" not in out + err
    assert states(archive) == {
        "a.h5": "done", "b.h5": "done", "c.h5": "stopped", "d.h5": "stopped", "e.h5": "waiting"
    }  # fmt: skip
    assert blocked.go_on() == 0
    assert archive.runs() == ["c.h5", "d.h5", "e.h5"]


def test_second_batch_is_refused_and_a_killed_worker_is_one_failed_survey(blocked, archive):
    second = blocked.start()
    _, err = second.communicate(timeout=PATIENCE_S)
    assert second.returncode == 2
    assert "another batch is running into this folder" in err
    assert blocked.process.poll() is None

    victim = next(process for name, process, _ in archive.begun() if name == "c.h5")
    os.kill(victim, signal.SIGKILL)
    until(lambda: states(archive)["c.h5"] == "failed", "the record of the failure")
    (archive.folder / "go").touch()
    code, _, err = blocked.end()
    assert code == 4
    assert "c.h5 [killed]: its process was ended by SIGKILL" in err
    assert sorted(states(archive).values()) == ["done", "done", "done", "done", "failed"]
