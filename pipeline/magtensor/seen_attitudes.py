"""Which attitudes a survey lacks, before any calibration or after one was refused: `magtensor inspect --attitudes`."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magtensor.atomic import atomic_path, refuse_overwriting, require_writable
from magtensor.calibration.coverage import Coverage, coverage_alone, same_postures, seen_directions
from magtensor.calibration.types import Array, Mask
from magtensor.closed_loop import loop_document
from magtensor.errors import DataError, NotEnoughData, UsageError
from magtensor.long_survey import windows
from magtensor.preparing import load_as
from magtensor.recipe.plan import Plan, plan
from magtensor.recipe.source import load_yaml
from magtensor.survey.model import Survey

if TYPE_CHECKING:
    from magtensor.report.missing_attitudes import Seen

RECIPES = (".yaml", ".yml")
FORMATS = (".svg", ".png", ".pdf")
MEMORY_GiB = 2.0  # a survey that takes more is read in windows
MOST_SAMPLES = 20_000  # of a sensor: enough to see every cone of a few degrees
LEAST_SAMPLES = 3
MISSING = "the picture needs matplotlib: pip install 'magtensor[report]'"


def draw_attitudes(
    file: Path,
    target: Path,
    *,
    survey: Path | None = None,
    overrides: Sequence[str] = (),
    plugin_folders: Sequence[Path] = (),
) -> list[str]:
    """Draw which attitudes each sensor saw, and which further ones a calibration would need most.

    Args:
        file: a survey in the canonical layout; or a recipe, whose stages before the calibration read and prepare its
            survey.
        target: the picture, .svg, .png or .pdf; whole or absent.
        survey: in place of the recipe's own.
        overrides, plugin_folders: as of a run.

    Returns:
        The verdict on each sensor in words.

    Raises:
        UsageError: the picture's name, the recipe, or matplotlib is not installed.
        DataError, NotEnoughData: the survey is wrong, or no sensor has samples in use.
    """
    if target.suffix.lower() not in FORMATS:
        raise UsageError(f"{target}: a picture's name ends with {', '.join(FORMATS)}")
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise UsageError(MISSING) from error
    if file.suffix.lower() in RECIPES:
        document, given = load_yaml(file), survey
    elif survey is not None:
        raise UsageError(f"--input takes the place of a recipe's survey, and {file} is no recipe")
    else:
        document, given = loop_document({}), file
    planned = plan(document, overrides=overrides, plugin_folders=plugin_folders, survey=given)
    require_writable(target.parent)
    refuse_overwriting([target], [file, *planned.source().files()])
    seen, measured = seen_attitudes(planned)
    _draw(seen, planned, measured, target)
    return [f"{s.sensor}: {s.verdict}" for s in seen]


def seen_attitudes(planned: Plan) -> tuple[list[Seen], bool]:
    """What the attitudes of each sensor of a recipe's survey can determine, and whether a total field was measured.

    Raises:
        NotEnoughData: a sensor has no samples in use.
    """
    from magtensor.report.missing_attitudes import Seen

    names, raw, total_field = _samples(planned)
    measured = total_field is not None
    alone, unit, used = [], [], list[Mask]()
    for s, name in enumerate(names):
        own = raw[:, s]
        if total_field is None:
            known = np.isfinite(own).all(axis=1)
            field = np.full(len(own), np.median(np.linalg.norm(own[known], axis=1)) if known.any() else np.nan)
        else:
            field = total_field
            known = np.isfinite(own).all(axis=1) & np.isfinite(field) & (field > 0)
        if known.sum() < LEAST_SAMPLES:
            raise NotEnoughData(
                f"{int(known.sum())} samples are in use", where=f"{planned.source().files()[0]}: {name}"
            )
        direction, found = judged(own[known], field[known])
        alone.append(found)
        unit.append(direction)
        used.append(np.asarray(known))
    turn = np.array([_turn(unit[0], used[0], u, k) for u, k in zip(unit, used, strict=True)])
    together = same_postures(alone, unit, turn)
    return [Seen(*one) for one in zip(names, unit, together, strict=True)], measured


def _turn(first: Array, used: Mask, other: Array, also: Mask) -> Array:
    """(3, 3) from the axes of the first sensor to those of another, by the directions that both saw; alike where these
    do not tell."""
    both = used & also
    a, b = first[both[used]], other[both[also]]
    u, _, v = np.linalg.svd(b.T @ a + 1e-3 * (len(a) + 1) * np.eye(3))
    out: Array = u @ v
    return out


def judged(raw: Array, total_field: Array) -> tuple[Array, Coverage]:
    """Directions (N, 3) of the field in a sensor's axes and what they determine, from raw (N, 3), total_field (N,) nT:
    with the fit of the nearest ellipsoid where there is one."""
    found, centre = coverage_alone(raw, total_field)
    return seen_directions(raw, total_field, centre), found


def _samples(planned: Plan) -> tuple[list[str], Array, Array | None]:
    """Sensors, raw (n, S, 3) nT with NaN where not in use, total field (n,) nT; evenly thinned."""
    try:
        where: list[slice | None] = [*windows(planned.source(), MEMORY_GiB)]
    except (UsageError, DataError):  # only one canonical file can be read in parts
        where = [None]
    if len(where) == 1:
        where = [None]
    parts = [_thinned(load_as(planned, None, tolerant=True, rows=rows), MOST_SAMPLES // len(where)) for rows in where]
    names = parts[0][0]
    fields = [field for _, _, field in parts if field is not None]
    return (
        names,
        np.concatenate([raw for _, raw, _ in parts]),
        np.concatenate(fields) if len(fields) == len(parts) else None,
    )


def _thinned(survey: Survey, most: int) -> tuple[list[str], Array, Array | None]:
    raw = np.array(survey.values("b_raw"), dtype=float)
    raw[~survey.good_by_sensor] = np.nan
    step = -(-len(raw) // most)
    field = np.asarray(survey.values("total_field"), dtype=float)[::step] if "total_field" in survey else None
    return survey.sensors, raw[::step], field


def _draw(seen: list[Seen], planned: Plan, measured: bool, target: Path) -> None:
    import matplotlib

    from magtensor.report.drawing import MOST_SENSORS, STYLE, label
    from magtensor.report.missing_attitudes import picture

    names = [f.name for f in planned.source().files()]
    more = "" if measured else "No total field was measured: it is taken as constant."
    if planned.survey is not None and planned.survey.with_:
        more += f" The further surveys of the recipe ({label(', '.join(names[1:]), 200)}) are not in it."
    shown = sorted(np.argsort([-s.found.further.worst[0] for s in seen], kind="stable")[:MOST_SENSORS])
    if len(shown) < len(seen):
        more += f" Of {len(seen)} sensors the {len(shown)} that know their worst direction least are shown."
    kind = target.suffix.lower()[1:]
    drawn = matplotlib.rc_context({**STYLE, "svg.fonttype": "path"})
    with drawn, warnings.catch_warnings(), atomic_path(target) as path:
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        figure = picture(
            [seen[k] for k in shown],
            f"Attitudes of {names[0]}: what was seen, and what a calibration lacks",
            more.strip(),
        )
        # no date: the same survey gives the same bytes
        undated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(kind)
        figure.savefig(path, format=kind, facecolor="white", metadata=undated, dpi=110)
