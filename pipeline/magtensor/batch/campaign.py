"""Runs a batch: plans once, gives the runner what is not done yet, keeps the record."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

from magtensor.batch import ledger as record
from magtensor.batch.freshness import why_run
from magtensor.batch.ledger import Entry, Ledger, only_batch
from magtensor.batch.process import ERROR_FILE, KINDS, Outcome, Task
from magtensor.batch.runners import DaskRunner, LocalRunner, Runner
from magtensor.batch.surveys import Wanted, folder_names, wanted_surveys
from magtensor.errors import BatchFailed, UsageError
from magtensor.recipe.overrides import override
from magtensor.recipe.plan import Plan, plan
from magtensor.recipe.source import Document, load_yaml
from magtensor.registry import Registry
from magtensor.result import RESULT

CANONICAL_READER = "hdf5"


@dataclass
class Summary:
    """How a batch ended.

    Attributes:
        output: its folder.
        run, reused: how many surveys were done now, and were done before.
        failures: one line each.
    """

    output: Path
    run: int = 0
    reused: int = 0
    failures: list[str] = field(default_factory=list)

    @property
    def total(self) -> int:
        """How many surveys were asked for."""
        return self.run + self.reused + len(self.failures)

    @property
    def sentence(self) -> str:
        """The batch in one line."""
        before = f" ({self.reused} of them before)" if self.reused else ""
        return (
            f"{self.run + self.reused} of {self.total} surveys done{before}, {len(self.failures)} failed; "
            f"record: {self.output / record.NAME}"
        )

    def raise_if_failed(self) -> None:
        """List the failures.

        Raises:
            BatchFailed: if there are any.
        """
        if self.failures:
            head = f"{len(self.failures)} of {self.total} surveys failed:"
            raise BatchFailed("\n  ".join([head, *self.failures]))


def run_batch(
    recipe: Path,
    surveys: Sequence[Path],
    output: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    overrides: Sequence[str] = (),
    plugin_folders: Sequence[Path] = (),
    say: Callable[[str], None] = print,
) -> Summary:
    """Run a recipe on many surveys; each survey's files go to a folder of its own in `output`.

    What is done already is not done again: a survey is done if its `result.nc` is there, whole, and was made from the
    same resolved recipe, the same bytes and the same versions of the package and the plugins. A survey that fails, or
    whose process is killed, stops no other.

    Args:
        recipe: the YAML file; read once.
        surveys: files, folders or glob patterns.
        output: the folder; `batch.json` in it tells the state of each survey.
        workers: processes at once; default: one per core.
        scheduler: address of a Dask scheduler in place of processes of this machine.
        overrides: `PATH=VALUE` texts.
        plugin_folders: folders of single-file plugins.
        say: takes one line for each survey that ends.

    Raises:
        UsageError: the recipe is wrong (every mistake, before anything is run), the output folder cannot be written
            or is in use by another batch, or no scheduler answers.
    """
    document = load_yaml(recipe)
    for text in overrides:
        document = override(document, text)
    folders = tuple(Path(f).resolve() for f in plugin_folders)
    wanted = wanted_surveys(surveys, survey_endings(document, folders))
    plans = plans_by_ending(document, folders, wanted)
    output = Path(os.path.abspath(output))
    with only_batch(output), signals_raise():
        runner: Runner = DaskRunner(scheduler) if scheduler else LocalRunner(workers)
        campaign = _Campaign(document, folders, wanted, plans, Ledger(output, str(recipe)), output, say)
        return campaign.run(runner)


def survey_endings(document: Document, plugin_folders: Sequence[Path]) -> tuple[str, ...]:
    """The file endings by which the surveys of a folder are known: those of the reader that the recipe will use."""
    recipe = document.value if isinstance(document.value, dict) else {}
    section = recipe.get("survey")
    section = {"file": section} if isinstance(section, str) else section if isinstance(section, dict) else {}
    named = recipe.get("plugins")
    named = [named] if isinstance(named, str) else named if isinstance(named, list) else []
    own_folders = [document.folder / n for n in named if isinstance(n, str) and (document.folder / n).exists()]
    readers = {
        name: component.suffixes
        for (kind, _, name), component in Registry.load([*plugin_folders, *own_folders]).components.items()
        if kind == "reader"
    }
    every = tuple(sorted({e for endings in readers.values() for e in endings}))
    if "reader" in section:
        return readers.get(str(section["reader"])) or every
    if "sensors" not in section:
        return readers.get(CANONICAL_READER) or every
    files = section.get("file") or section.get("files")
    example = str(files[0] if isinstance(files, list) and files else files or "").lower()
    return next((found for found in readers.values() if any(example.endswith(e.lower()) for e in found)), every)


def plans_by_ending(
    document: Document, plugin_folders: Sequence[Path], wanted: Sequence[Wanted]
) -> dict[str, Plan | UsageError]:
    """A plan for each kind of file, since the reader goes by the file's ending.

    Raises:
        UsageError: the recipe can be planned for none of the files.
    """
    plans: dict[str, Plan | UsageError] = {}
    for one in [w for w in wanted if not w.problem] or wanted:
        ending = one.path.suffix
        if ending not in plans:
            try:
                plans[ending] = plan(document, plugin_folders=plugin_folders, survey=one.path)
            except UsageError as error:
                plans[ending] = error
    problems = [p for p in plans.values() if isinstance(p, UsageError)]
    if problems and len(problems) == len(plans):
        raise problems[0]
    return plans


class _Campaign:
    def __init__(
        self,
        document: Document,
        plugin_folders: tuple[Path, ...],
        wanted: Sequence[Wanted],
        plans: Mapping[str, Plan | UsageError],
        ledger: Ledger,
        output: Path,
        say: Callable[[str], None],
    ) -> None:
        self.document, self.plugin_folders, self.plans = document, plugin_folders, plans
        self.wanted, self.ledger, self.output, self.say = wanted, ledger, output, say
        recorded = {Path(e.survey): e.folder for e in ledger.entries.values()}
        reserved = (record.NAME, record.LOCK)
        self.folders = folder_names([w.path for w in wanted], recorded, reserved)
        self.summary = Summary(output)

    def run(self, runner: Runner) -> Summary:
        if self.ledger.damage:
            self.say(f"{self.ledger.damage}; each result is asked itself what it was made from")
        known = self.ledger.entries
        entries = [known.get(str(w.path), self.entry(w.path, state="waiting")) for w in self.wanted]
        self.ledger.put(*(e if e.state == "done" else replace(e, state="waiting") for e in entries))
        try:
            with closing(runner.run(self.tasks())) as ended:
                for task, outcome in ended:
                    self.end(task.survey, outcome)
        except (KeyboardInterrupt, SystemExit):
            self.say(f"stopped after {self.summary.total} of {len(self.wanted)} surveys; the same command continues")
            raise
        finally:
            mine = {str(w.path) for w in self.wanted}
            halted = [e for e in known.values() if e.survey in mine and e.state == "running"]
            if halted:
                self.ledger.put(*(replace(e, state="stopped") for e in halted))
        return self.summary

    def tasks(self) -> Iterator[Task]:
        """What is to be run; what is done, or cannot even be begun, is recorded on the way."""
        for one in self.wanted:
            if one.problem:
                self.end(one.path, Outcome(3, f"{one.path}: {one.problem}", 0.0))
                continue
            planned = self.plans[one.path.suffix]
            if isinstance(planned, UsageError):
                self.end(one.path, Outcome(2, str(planned), 0.0))
                continue
            folder = self.output / self.folders[one.path]
            why = why_run(folder, replace(planned, survey=planned.survey_for(one.path)))
            if why:
                self.ledger.put(self.entry(one.path, state="running", why=why))
                yield Task(one.path, folder, self.document, self.plugin_folders)
            else:
                self.reuse(one.path)

    def entry(self, survey: Path, **facts: Any) -> Entry:
        return Entry(survey=str(survey), folder=self.folders[survey], **facts)

    def reuse(self, survey: Path) -> None:
        self.summary.reused += 1
        if self.ledger.entries[str(survey)].state != "done":  # killed before it was recorded, or changed back
            (self.output / self.folders[survey] / ERROR_FILE).unlink(missing_ok=True)
            self.ledger.put(self.entry(survey, state="done", why="its result was found whole", exit_status=0))
        self.say(f"{self.place()} {shown(survey)}: done already")

    def end(self, survey: Path, outcome: Outcome) -> None:
        before = self.ledger.entries[str(survey)]
        why = before.why if before.state == "running" else ""
        message = outcome.message
        first = message.split("\n", 1)[0]
        if outcome.exit_status == 0:
            self.summary.run += 1
            again = "" if why == "no result yet" else f" ({why})"
            line = f"done in {outcome.seconds:.1f} s{again}: {first}"
        else:
            folder = self.output / self.folders[survey]
            if (folder / ERROR_FILE).is_file():
                first += f"; see {shown(folder / ERROR_FILE)}"
            if (folder / RESULT).is_file():
                message += f"\n  {RESULT} in {folder.name} is an older one: {why or 'this survey was not run'}"
            kind = outcome.kind if outcome.exit_status not in KINDS else f"{outcome.kind}, {outcome.exit_status}"
            self.summary.failures.append(f"{shown(survey)} [{kind}]: {first}")
            line = f"failed [{kind}]: {first}"
        now = datetime.now(UTC).isoformat(timespec="seconds")
        self.ledger.put(
            self.entry(
                survey,
                state="failed" if outcome.exit_status else "done",
                why=why,
                exit_status=outcome.exit_status,
                seconds=round(outcome.seconds, 3),
                finished=now,
                message=message,
            )
        )
        self.say(f"{self.place()} {shown(survey)}: {line}")

    def place(self) -> str:
        return f"[{self.summary.total}/{len(self.wanted)}]"


def shown(path: Path) -> str:
    """A path as short as it can be written from here."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


@contextmanager
def signals_raise() -> Iterator[None]:
    """Inside, the first SIGINT or SIGTERM raises (KeyboardInterrupt, SystemExit); further ones wait for the tidying."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    watched = (signal.SIGINT, signal.SIGTERM)

    def stop(number: int, frame: FrameType | None) -> None:
        for one in watched:
            signal.signal(one, signal.SIG_IGN)
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)

    before = {one: signal.signal(one, stop) for one in watched}
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
