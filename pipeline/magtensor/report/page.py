"""Puts the page together and writes it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magtensor.report.content import Content
    from magtensor.verdict_words import Told

PAGE = "report.html"
UNTITLED = "Calibration of a magnetometer array"
ATTRIBUTES = ("title", "instrument", "platform", "site", "operator", "shown")  # of the survey, where it has them
MISSING = "the report needs matplotlib and jinja2: pip install 'magtensor[report]'"


def write_report(directory: Path, *, required: bool = False) -> Path | None:
    """Write `report.html` beside the `result.nc` and `verdict.json` that it is made from.

    Args:
        directory: the folder of a finished run.
        required: refuse, rather than do nothing, where the optional libraries are not installed.

    Returns:
        The page; None where the libraries are not installed.

    Raises:
        UsageError: they are not installed and the page was required.
        DataError: the folder holds no result, or one that cannot be read.
    """
    try:
        import jinja2  # noqa: F401
        import matplotlib  # noqa: F401
    except ImportError as error:
        if required:
            from magtensor.errors import UsageError

            raise UsageError(MISSING) from error
        return None
    from magtensor.atomic import write_text
    from magtensor.report.content import read

    path = Path(directory) / PAGE
    write_text(path, page(read(Path(directory))))
    return path


def page(content: Content) -> str:
    """The page as text; the same result gives the same bytes."""
    import jinja2

    from magtensor.report import tables
    from magtensor.report.drawing import Picture

    folder = Path(__file__).parent
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    environment.tests["picture"] = lambda shown: isinstance(shown, Picture)
    environment.filters.update(number=tables.number, compact=tables.compact, coefficient=tables.coefficient)
    style = (folder / "page.css").read_text(encoding="utf-8")
    # lone surrogates cannot be written as UTF-8
    text = environment.get_template("page.html.j2").render(style=style, **facts(content))
    return text.encode("utf-8", "replace").decode("utf-8")


def facts(content: Content) -> dict[str, Any]:
    """Everything the template shows."""
    from magtensor.report import tables
    from magtensor.report.gallery import gallery

    made_by = content.provenance
    recipe: Mapping[str, Any] = made_by.recipe if made_by else {}
    flags, more_flags = tables.flag_groups(content)
    judgements = tables.judgements(content)
    return {
        "title": str(recipe.get("title") or content.survey.attributes.get("title") or UNTITLED),
        "recipe": recipe,
        "recipe_text": _yaml(recipe),
        "survey_facts": survey_facts(content),
        "told": _told(content),
        "found": {"adopted": [], "rejected": [], "not_tested": [], **(content.outcome or {})},
        "unexplained": _unexplained(content),
        "errors": tables.errors(content),
        "judgements": judgements,
        "counts": [(s, sum(j.state == s for j in judgements)) for s in tables.ORDER],
        "worst": judgements[0].state if judgements else "none",
        "gallery": gallery(content),
        "attitudes": tables.attitudes(content),
        "flags": flags,
        "more_flags": more_flags,
        "per_sensor": tables.per_sensor(content),
        "parameters": tables.parameters(content),
        "correction": tables.correction(content),
        "unobservable": tables.unobservable(content),
        "frame": content.frame,
        "diagnostics": tables.diagnostics(content),
        "made_by": made_by,
    }


def survey_facts(content: Content) -> list[tuple[str, str]]:
    """When, how long, how many: what one checks first to know that it is the right survey."""
    import numpy as np

    from magtensor.report.clock import clock, instant
    from magtensor.report.tables import count, number

    time = content.time[np.isfinite(content.time)]
    attributes = content.survey.attributes
    shown = [(k, str(attributes[k])) for k in ATTRIBUTES if attributes.get(k)]
    if content.sensors:
        shown.append(("sensors", f"{len(content.sensors)}: {', '.join(content.sensors)}"))
    if time.size:
        shown.append(("begins", instant(float(time[0]), content.time_units)))
        shown.append(("ends", instant(float(time[-1]), content.time_units)))
        shown.append(("samples", f"{count(len(content.time))}, of which {count(int(content.good.sum()))} in use"))
    if time.size > 1:
        step = float(np.median(np.diff(time)))
        axis = clock(time, content.time_units)
        shown.append(("length", f"{number(float(axis.values[-1]))} {axis.unit}"))
        if step > 0:
            shown.append(("rate", f"{number(1 / step)} Hz" if step < 1 else f"one in {number(step)} s"))
    return shown


def _unexplained(content: Content) -> Mapping[str, Any] | None:
    """What the loop could not explain, where it looked and found something."""
    said = (content.outcome or {}).get("unexplained") or {}
    return said if said.get("present") else None


def _told(content: Content) -> Told:
    from magtensor.verdict_words import Told, told

    return Told("There is no verdict.json beside this result") if content.outcome is None else told(content.outcome)


def _yaml(recipe: Mapping[str, Any]) -> str:
    import yaml

    return str(yaml.safe_dump(dict(recipe), sort_keys=False, allow_unicode=True, width=100)) if recipe else ""
