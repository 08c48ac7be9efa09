"""The command line. Imports are inside the commands: `magtensor --help` must answer at once."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import click

from magtensor import __version__
from magtensor.errors import MagtensorError
from magtensor.sharing import PROCESSES, cores

FILE = click.Path(path_type=Path, dir_okay=False)
FOLDER = click.Path(path_type=Path, file_okay=False)
READER_GONE = 141  # as of a program that SIGPIPE ends
memory_option = click.option(
    "--memory", "memory_GiB", type=click.FloatRange(min=0, min_open=True), metavar="GIB",
    help="Work through a survey longer than this in windows.",
)  # fmt: skip
plugins_option = click.option(
    "--plugins", "plugin_folders", type=click.Path(path_type=Path), multiple=True, metavar="FOLDER",
    help="A folder of single-file plugins (or one such file); may be given several times.",
)  # fmt: skip
verify_option = click.option(
    "--verify", type=FILE,
    help="A second survey in a uniform field; its error goes into the verdict. In place of the recipe's own.",
)  # fmt: skip
set_option = click.option(
    "--set", "overrides", multiple=True, metavar="PATH=VALUE",
    help="Change one value of the recipe, e.g. stages.align.to=S2; may be given several times.",
)  # fmt: skip


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="magtensor")
def cli() -> None:
    """Calibrate magnetic gradient tensor systems with declarative recipes."""


@cli.command()
@click.argument("recipe", type=FILE)
@click.option("--input", "survey", type=FILE, help="The survey, in place of the recipe's own.")
@verify_option
@click.option("--output", type=FOLDER, help="Folder for the results; default: the recipe's name with .result.")
@memory_option
@set_option
@plugins_option
def run(
    recipe: Path,
    survey: Path | None,
    verify: Path | None,
    output: Path | None,
    memory_GiB: float | None,
    overrides: tuple[str, ...],
    plugin_folders: tuple[Path, ...],
) -> None:
    """Run RECIPE on a survey, or a result.nc again from its own provenance."""
    from magtensor.session import run_recipe
    from magtensor.verdict_words import lines

    directory = output or Path(f"{recipe.stem}.result")
    finished = run_recipe(
        recipe, directory, survey=survey, verify=verify, overrides=overrides, plugin_folders=plugin_folders,
        progress=_progress(), memory_GiB=memory_GiB,
    )  # fmt: skip
    _progress_end()
    for note in finished.notes:
        click.echo(note)
    click.echo(f"results: {directory / 'result.nc'}")
    if (directory / "report.html").is_file():
        click.echo(f"report:  {directory / 'report.html'}")
    else:
        click.echo("report:  not written; it needs matplotlib and jinja2: pip install 'magtensor[report]'")
    for line in lines(finished.outcome):
        click.echo(line)


@cli.command()
@click.argument("calibration", type=FILE)
@click.argument("survey", type=FILE)
@click.option("--output", type=FILE, help="Default: the survey's name with .calibrated.nc.")
@click.option(
    "--memory",
    "memory_GiB",
    type=click.FloatRange(min=0, min_open=True),
    metavar="GIB",
    help="Work through a survey longer than this in windows. Refused with --refine-rotation and --save-calibration, "
    "and for a calibration that holds effects: they need the whole survey at once.",
)
@click.option(
    "--refine-rotation", is_flag=True,
    help="Turn the common frame until the tensor of this survey is symmetric, if its gradients tell that well enough.",
)  # fmt: skip
@click.option("--save-calibration", type=FILE, help="Write the calibration as it was applied, for further surveys.")
def apply(
    calibration: Path,
    survey: Path,
    output: Path | None,
    memory_GiB: float | None,
    refine_rotation: bool,
    save_calibration: Path | None,
) -> None:
    """Apply a stored CALIBRATION to another SURVEY."""
    from magtensor import applying

    applied = applying.apply(
        calibration, survey, output, memory_GiB=memory_GiB, refine_rotation=refine_rotation,
        save_calibration=save_calibration,
    )  # fmt: skip
    click.echo(f"calibrated: {applied.file}")
    if applied.refined:
        click.echo(f"common rotation: {applied.refined}.")
    for note in applied.notes:
        click.echo(note)
    click.echo(applied.sentence)


@cli.command()
@click.argument("recipe", type=FILE)
@click.argument("surveys", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option("--output", type=FOLDER, required=True, help="Folder; each survey gets a folder of its own in it.")
@click.option("--workers", type=click.IntRange(1), default=None, help="Processes; default: one per core.")
@click.option("--scheduler", metavar="ADDRESS", help="A Dask scheduler in place of local processes.")
@set_option
@plugins_option
def batch(
    recipe: Path,
    surveys: tuple[Path, ...],
    output: Path,
    workers: int | None,
    scheduler: str | None,
    overrides: tuple[str, ...],
    plugin_folders: tuple[Path, ...],
) -> None:
    """Run RECIPE on many SURVEYS; what is done already is not done again."""
    from magtensor.batch import run_batch

    summary = run_batch(
        recipe, surveys, output, workers=workers, scheduler=scheduler, overrides=overrides,
        plugin_folders=plugin_folders, say=click.echo,
    )  # fmt: skip
    click.echo(summary.sentence)
    summary.raise_if_failed()


@cli.command()
@click.argument("recipe", type=FILE)
@click.option("--input", "survey", type=FILE, help="The survey, in place of the recipe's own.")
@set_option
@plugins_option
def validate(recipe: Path, survey: Path | None, overrides: tuple[str, ...], plugin_folders: tuple[Path, ...]) -> None:
    """Check RECIPE completely without reading any data."""
    from magtensor.recipe.plan import read_plan

    planned = read_plan(recipe, overrides=overrides, plugin_folders=plugin_folders, survey=survey)
    click.echo(f"{recipe}: valid; {len(planned.stages)} stages: {', '.join(s.name for s in planned.stages)}")


@cli.command()
@click.argument("file", type=FILE)
@click.option("--reader", help="The reader plugin; default: by the file name's ending.")
@click.option(
    "--attitudes", "picture", type=FILE, metavar="PICTURE",
    help="Draw (.svg, .png, .pdf) which attitudes the sensors saw and which further ones a calibration needs most. "
    "FILE is then a survey in the canonical layout, or a recipe that reads and prepares one.",
)  # fmt: skip
@click.option("--input", "survey", type=FILE, help="With --attitudes: the survey, in place of the recipe's own.")
@click.option("--set", "overrides", multiple=True, metavar="PATH=VALUE", help="With --attitudes: as of `run`.")
@plugins_option
def inspect(
    file: Path,
    reader: str | None,
    picture: Path | None,
    survey: Path | None,
    overrides: tuple[str, ...],
    plugin_folders: tuple[Path, ...],
) -> None:
    """Show what FILE holds, and propose a mapping for a recipe; or draw the attitudes of a survey."""
    if picture is None:
        from magtensor.survey.inspect import show

        if survey is not None or overrides:
            raise click.UsageError("--input and --set go with --attitudes")
        show(file, reader, plugin_folders)
        return
    from magtensor.seen_attitudes import draw_attitudes

    if reader is not None:
        raise click.UsageError("--attitudes takes no --reader: a recipe says how its survey is read")
    for line in draw_attitudes(file, picture, survey=survey, overrides=overrides, plugin_folders=plugin_folders):
        click.echo(line)
    click.echo(f"attitudes: {picture}")


@cli.command()
@click.option("--json", "as_json", is_flag=True, help="Print as JSON, option schemas included.")
@click.argument("words", nargs=-1, metavar="[[check] NAME]")
@plugins_option
def plugins(as_json: bool, words: tuple[str, ...], plugin_folders: tuple[Path, ...]) -> None:
    """List every plugin and what it gives; NAME shows one component in full.

    `magtensor plugins check NAME` tries an error model: its declarations, units, determinism, and what it does on
    surveys of several kinds.
    """
    from magtensor.listing import describe, show_one, show_plugins
    from magtensor.registry import Registry

    if len(words) > 2 or (len(words) == 2 and words[0] != "check"):
        raise click.UsageError("give a NAME, or `check NAME`")
    name = words[-1] if words else ""
    registry = Registry.load(plugin_folders)
    if len(words) == 2:
        from magtensor.errors import UsageError
        from magtensor.loop.checker import check_error_model

        if faults := check_error_model(registry.find("error_model", name)):
            raise UsageError("\n".join(f"{name}: {fault}" for fault in faults))
        click.echo(f"{name}: nothing to complain about")
    elif as_json:
        click.echo(json.dumps(describe(registry), indent=2))
    elif name:
        show_one(registry, name)
    else:
        show_plugins(registry)
    registry.check()


@cli.command()
@click.argument("file", type=FILE, metavar="SURVEY")
@click.option("--input", "survey", type=FILE, help="The survey, in place of a recipe's own.")
@verify_option
@click.option("--output", type=FOLDER, help="Folder for the results; default: the survey's name with .explored.")
@plugins_option
def explore(
    file: Path, survey: Path | None, verify: Path | None, output: Path | None, plugin_folders: tuple[Path, ...]
) -> int:
    """See what a calibration of SURVEY leaves, adopt and reject error models by hand, look again.

    SURVEY may also be a recipe with the stage close_loop, such as the file of an earlier session. Commands are typed
    at the prompt or piped in; `help` lists them.
    """
    from magtensor.prompt import converse

    return converse(file, survey=survey, verify=verify, output=output, plugins=plugin_folders)


@cli.command()
@click.argument("scenario", type=FILE)
@click.option("--output", type=FILE, required=True, help="The survey file to write.")
@click.option("--set", "overrides", multiple=True, metavar="PATH=VALUE", help="Change one value of the scenario.")
def simulate(scenario: Path, output: Path, overrides: tuple[str, ...]) -> None:
    """Simulate the survey that SCENARIO describes, in the canonical layout."""
    from magtensor.simulate.command import simulate_file

    click.echo(simulate_file(scenario, output, overrides))


@cli.command()
@click.argument("directory", type=FOLDER)
def report(directory: Path) -> None:
    """Write report.html anew from the results in DIRECTORY."""
    from magtensor.report import write_report

    click.echo(f"report: {write_report(directory, required=True)}")


def _progress() -> Any:
    if not sys.stderr.isatty():
        return None

    def show(stage: str) -> None:
        click.echo(f"\r\033[K{stage} ...", nl=False, err=True)

    return show


def _progress_end() -> None:
    if sys.stderr.isatty():
        click.echo("\r\033[K", nl=False, err=True)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and leave with the exit status of the contract."""
    sys.exit(status_of(arguments))


def status_of(arguments: list[str] | None = None) -> int:
    """Run the command line; a user's mistake is one message, a bug keeps its traceback (exit status 1)."""
    # one BLAS thread: the matrices are tall and narrow, where more threads only wait for each other, and sums in one
    # order give the same bits again
    for variable in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    os.environ.setdefault(PROCESSES, str(cores()))
    try:
        outcome = cli.main(args=arguments, prog_name="magtensor", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        return 2
    except click.Abort:
        click.echo("stopped", err=True)
        return 130
    except SystemExit as error:
        if isinstance(error.__context__, BrokenPipeError):  # click leaves so where nobody reads what is printed
            return READER_GONE
        raise
    except MagtensorError as error:
        _progress_end()
        click.echo(f"error: {error}", err=True)
        return error.exit_status
    return outcome if isinstance(outcome, int) else 0
