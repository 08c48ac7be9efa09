"""`magtensor explore`: a line-based session with an Explorer, at a terminal or with commands piped in."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from magtensor.accuracy import figure
from magtensor.atomic import refuse_overwriting, require_writable, write_text
from magtensor.closed_loop import STAGE, loop_document, summary
from magtensor.errors import MagtensorError, UsageError, did_you_mean
from magtensor.explorer import Explorer
from magtensor.recipe.source import load_yaml
from magtensor.refusal import picture_named
from magtensor.verdict_words import lines, lines_of_the_rest

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

PROMPT = "explore> "
RECIPES = (".yaml", ".yml")
HELP = {
    "residual": "what is left: rms of each sensor, and whether it is noise",
    "ranking": "the error models that explain most of it, with the evidence",
    "adopt NAME [setting=value ...]": "put an error model into the calibration; settings left out are searched",
    "reject NAME": "take an error model out, or off the ranking",
    "loop": "let the loop search on from here",
    "undo": "take the last decision back",
    "load FILE": "take the error models of a plugin file into the ranking; again after it was changed",
    "show NAME": "what an error model is, and its settings",
    "status": "the model as it stands, and the decisions so far",
    "verdict": "the verdict as it would be saved now",
    "save [FOLDER]": "write result.nc, calibration.nc, verdict.json and report.html",
    "help": "this list",
    "quit": "end the session",
}


def converse(
    file: Path,
    *,
    survey: Path | None = None,
    verify: Path | None = None,
    output: Path | None = None,
    plugins: Sequence[Path] = (),
) -> int:
    """Hold a session on a survey, or on a recipe with its survey.

    Args:
        file: a survey in the canonical layout; or a recipe (.yaml) with the stage `close_loop`, such as the file
            that an earlier session left.
        survey: in place of the recipe's own.
        verify: a second survey, for the verdict; in place of the recipe's own.
        output: folder for the result; default: the file's name with `.explored`.
        plugins: folders of single-file plugins, or such files.

    Returns:
        The exit status: 2 where commands were piped in and one of them was refused, else 0.
    """
    from rich.console import Console

    if file.suffix.lower() in RECIPES:
        document, given = load_yaml(file), survey
    elif survey is not None:
        raise UsageError(f"--input takes the place of a recipe's survey, and {file} is no recipe")
    else:
        document, given = loop_document({}), file
    directory = output or Path(f"{file.stem}.explored")
    require_writable(directory)
    console = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else 160)
    with picture_named(file, survey=survey, plugin_folders=plugins):
        explorer = Explorer(document, given, verify=verify, plugins=plugins)
    refuse_overwriting([directory / "result.nc"], explorer.inputs)
    session = Session(explorer, console, directory, _journal(file, directory, survey, verify))
    console.print(f"{file}: `help` lists the commands")
    session.status()
    session.run(_typed() if sys.stdin.isatty() else _piped(console))
    return 2 if session.refused and not sys.stdin.isatty() else 0


@dataclass
class Session:
    """A session: its commands are the methods named as they are.

    Attributes:
        explorer: what is explored.
        console: where it is shown.
        directory: where `save` writes to.
        journal: a recipe with all decisions, written anew after each of them.
        refused: commands that were mistakes.
        saved: decisions when the result was last written; None before.
    """

    explorer: Explorer
    console: Console
    directory: Path
    journal: Path
    refused: int = 0
    saved: list[tuple[str, str]] | None = None
    _written: list[tuple[str, str]] = field(default_factory=list)

    def run(self, lines: Iterator[str]) -> None:
        """Take commands until there are no more; a mistake costs one line, and the session goes on."""
        self._written = self.explorer.decisions if self.journal.exists() else []
        for line in lines:
            text = line.split("#", 1)[0].strip()
            if not text:
                continue
            if text in ("quit", "exit", "q"):
                break
            try:
                self.take(text)
            except MagtensorError as error:
                self.refuse(str(error))
            except KeyboardInterrupt:
                self.refuse("stopped; nothing has changed")
            except Exception as error:  # a plugin's bug must not cost what was done before
                self.refuse(f"{type(error).__name__}: {error}{_place(error)}")
        self._end()

    def take(self, text: str) -> None:
        """One command.

        Raises:
            UsageError: it is none.
        """
        name, _, rest = text.partition(" ")
        commands: dict[str, Callable[[str], None]] = {
            "residual": lambda _: self.residual(), "ranking": lambda _: self.ranking(), "adopt": self.decide,
            "reject": self.decide, "loop": self.decide, "undo": lambda _: self.undo(), "load": self.load,
            "show": self.show, "status": lambda _: self.status(), "verdict": lambda _: self.verdict(),
            "save": self.save, "help": lambda _: self.help(),
        }  # fmt: skip
        if name not in commands:
            raise UsageError(f"there is no command {name!r}{did_you_mean(name, commands) or '; `help` lists them'}")
        commands[name](text if commands[name] == self.decide else rest.strip())
        self._keep()

    def refuse(self, message: str) -> None:
        """Say what was wrong, in one line."""
        self.refused += 1
        self.console.print(f"error: {' '.join(message.split())}", style="red", markup=False)

    def residual(self) -> None:
        """The rms of what is left, and what it is like."""
        left = self.explorer.residual
        table = self._table("sensor", "|b| - F, nT rms", "contrast x, y, z, nT rms", "noise x, y, z, nT")
        for s, sensor in enumerate(left["sensor"].values):
            along = float((left["total_field"][:, s] ** 2).mean() ** 0.5)
            contrast = (left["contrast"][:, s] ** 2).mean("time").values ** 0.5
            noise = left["noise"][s].values
            table.add_row(
                str(sensor), figure(along), ", ".join(figure(float(v)) for v in contrast),
                ", ".join(figure(float(v)) for v in noise),
            )  # fmt: skip
        self.console.print(table)
        words = self.explorer.left_over()
        for line in lines_of_the_rest(words):
            self._say(line)
        if words["looks_like"]:
            self._say(f"looks like: {', '.join(words['looks_like'])}")

    def ranking(self) -> None:
        """The candidates, best first."""
        found = self.explorer.ranking()
        table = self._table("error model", "settings", "held-out gain", "t", "p", "gates", "judgement")
        for name, row in found.iterrows():
            settings = " ".join(f"{k}={_short(v)}" for k, v in row["settings"].items())
            table.add_row(
                str(name), settings, f"{row['held_out_gain']:.4g}", f"{row['t']:.2g}", f"{row['p']:.2g}",
                "pass" if row["passes"] else "-", str(row["judgement"]).split(":")[0] if not row["passes"] else "",
            )  # fmt: skip
        self.console.print(table if len(found) else "no error model is open")
        if lacking := self.explorer.not_tested:
            self._say("not tested: " + ", ".join(f"{n} ({' and '.join(w)})" for n, w in sorted(lacking.items())))

    def decide(self, text: str) -> None:
        """Adopt, reject, or let the loop search."""
        self._say(self.explorer.decide(text))
        self._say(self.explorer.summary())

    def undo(self) -> None:
        """Take the last decision back."""
        self._say(f"undone: {self.explorer.undo()}")

    def load(self, path: str) -> None:
        """A plugin file."""
        words = _words(path)
        if len(words) != 1:
            raise UsageError("write `load FILE`")
        names = self.explorer.load_plugin(words[0])
        self._say(f"loaded: {', '.join(names)}" if names else "loaded; nothing in it has changed")

    def show(self, name: str) -> None:
        """An error model."""
        if not name:
            raise UsageError("write `show NAME`; `ranking` lists error models")
        component = self.explorer.registry.find("error_model", name)
        self._say(f"{component.name} ({component.effect}; typically {component.typical or 'not said'})")
        self._say(component.summary)
        for setting, parameter in component.parameters.items():
            notes = [getattr(m, "description", None) for m in getattr(parameter.annotation, "__metadata__", ())]
            self._say(f"  {setting}: {next((n for n in notes if n), '')}")

    def status(self) -> None:
        """The model and the decisions."""
        self._say(self.explorer.summary())
        for number, (decision, told) in enumerate(self.explorer.decisions, 1):
            self._say(f"  {number}. {decision}: {told}")

    def verdict(self) -> None:
        """The verdict."""
        self._say(summary(self.explorer.verdict()))

    def save(self, folder: str) -> None:
        """The result."""
        words = _words(folder)
        if len(words) > 1:
            raise UsageError("write `save [FOLDER]`; a name with blanks needs quotes")
        directory = Path(words[0]) if words else self.directory
        refuse_overwriting([directory / "result.nc"], self.explorer.inputs)
        require_writable(directory)
        finished = self.explorer.save(directory)
        self.saved = self.explorer.decisions
        self._say(f"results: {directory / 'result.nc'}")
        for line in lines(finished.outcome):
            self._say(line)

    def help(self) -> None:
        """The commands."""
        table = self._table("command", "")
        for command, words in HELP.items():
            table.add_row(command, words)
        self.console.print(table)

    def _keep(self) -> None:
        """The decisions in the journal, as soon as there is something to lose."""
        if self.explorer.decisions != self._written:
            write_text(self.journal, self.explorer.recipe())
            self._written = self.explorer.decisions

    def _end(self) -> None:
        if self.saved == self.explorer.decisions or not self.explorer.decisions:
            return
        try:
            self._keep()
        except MagtensorError as error:
            self.refuse(str(error))
            made = "; ".join(decision for decision, _ in self.explorer.decisions)
            self._say(f"not saved as a result, and no file holds the decisions: {made}")
            return
        self._say(
            f"not saved as a result; {self.journal} holds the decisions: `magtensor explore {self.journal}` takes them "
            f"up, `magtensor run {self.journal}` makes the result"
        )

    def _say(self, words: str) -> None:
        self.console.print(words, markup=False)

    def _table(self, *headings: str) -> Table:
        from rich import box
        from rich.table import Table

        table = Table(box=box.SIMPLE, pad_edge=False)
        for heading in headings:
            table.add_column(heading, overflow="fold")
        return table


def _journal(file: Path, directory: Path, survey: Path | None, verify: Path | None) -> Path:
    """A session goes on in its own file, unless with another survey or verified by another; another recipe's stays
    beside it, so that relative names still hold."""
    if file.suffix.lower() not in RECIPES:
        folder, stem = directory, file.stem
    else:
        recipe = load_yaml(file).value
        decided = any(isinstance(s, dict) and (s.get(STAGE) or {}).get("decisions") for s in recipe["stages"])
        if decided and survey is None and (verify is None or str(verify.resolve()) == recipe.get("verify")):
            return file
        folder, stem = file.parent, re.sub(r"\.session-\d+$", "", file.stem)
    number = 1
    while (folder / f"{stem}.session-{number}.yaml").exists():
        number += 1
    return folder / f"{stem}.session-{number}.yaml"


def _typed() -> Iterator[str]:
    import contextlib

    with contextlib.suppress(ImportError):
        import readline  # noqa: F401  # arrow keys and history
    while True:
        try:
            yield input(PROMPT)
        except EOFError:
            return
        except KeyboardInterrupt:
            print()


def _piped(console: Console) -> Iterator[str]:
    for line in sys.stdin:
        console.print(f"{PROMPT}{line.rstrip()}", markup=False)
        yield line


def _words(text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise UsageError(f"{text!r} cannot be read: {error}") from error


def _place(error: Exception) -> str:
    import traceback

    frames = traceback.extract_tb(error.__traceback__)
    return f" ({frames[-1].filename}:{frames[-1].lineno})" if frames else ""


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
