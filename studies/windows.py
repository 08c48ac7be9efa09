"""What the loop says of parts of the measured recordings, each a survey of its own.

    python studies/windows.py --rows build/windows.jsonl --page docs/measured/windows.md [--only balloon]

Every part is loaded as the recipe of its recording says and goes through the stages of `recipes/closed_loop.yaml`, with
nothing else declared or left out. No number was set on them, but what the balloon's parts showed led to three rules
(the noise of rates of change, parts of what failed, events that a drift predicts), of which its rows are no test. Parts
of a recording should tell the same: what one of them adopts and no other bears out is either weak there or an
accusation. The recordings are not part of the project (docs/measured/README.md). Parts that are not in the table were
not waited for. The fit with sensors near nominal has changed: the first three weeks of Boulder and the first hours of
Conrad were made again with it, and before that the first two parts of the quadcopter; the other parts near nominal, and
the last week and the whole month of Boulder, which were refused, were not. The balloon's three parts of twenty minutes
were made again too. The two of BROAD with a magnet, 32 and 34, led to the search for an event as strong as the field,
of which they are no test.
"""

from __future__ import annotations

import copy
import json
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import trials
import yaml

from magtensor.errors import MagtensorError
from magtensor.session import run_recipe

RECIPES = Path(__file__).resolve().parents[1] / "recipes"
DAY_S, HOUR_S = 86_400, 3_600
BROAD = (
    "02_undisturbed_slow_rotation_B",
    "03_undisturbed_slow_rotation_C",
    "07_undisturbed_fast_rotation_B",
    "32_disturbed_attached_magnet_1cm",
    "34_disturbed_attached_magnet_3cm",
)


class Part(NamedTuple):
    """A part of a recording.

    Attributes:
        recipe: in recipes/measured; begin, end: s, 0 for all of it.
        sensor: the only one, "" for all; file: another one of the same kind, without its suffix.
    """

    recipe: str
    begin: float = 0.0
    end: float = 0.0
    sensor: str = ""
    file: str = ""


def parts() -> list[Part]:
    """All of them."""
    balloon = [(900, 2100), (3300, 4600), (2100, 3300), (900, 2750), (2750, 4600)]
    quadcopter = [(0, 75), (30, 110), (70, 145), (0, 145)]
    return [
        *(Part("loop_quadcopter", *window) for window in quadcopter),
        *(Part("loop_quadcopter", *quadcopter[-1], sensor) for sensor in ("external", "internal")),
        *(Part("broad", file=name) for name in BROAD),
        *(Part("boulder", day * DAY_S, (day + 7) * DAY_S) for day in (0, 7, 14, 21)),
        Part("boulder"),
        *(Part("conrad", hour * HOUR_S, (hour + 4) * HOUR_S) for hour in (0, 8, 16)),
        *(Part("loop_balloon", *window) for window in balloon),
        *(Part("loop_balloon", *balloon[-2], sensor) for sensor in ("RM3100", "AK09916")),
        Part("conrad"),
        *(Part("conrad", sensor=sensor) for sensor in ("FGE", "LEMI036")),
    ]


def recipe_of(part: Part) -> dict[str, Any]:
    """The recipe that loads a part as its recording's own does and closes the loop on it."""
    folder = RECIPES / "measured"
    found: dict[str, Any] = yaml.safe_load((folder / f"{part.recipe}.yaml").read_text(encoding="utf-8"))
    stages = copy.deepcopy(yaml.safe_load((RECIPES / "closed_loop.yaml").read_text(encoding="utf-8"))["stages"])
    if part.end:
        stages[0]["load"]["window_s"] = [part.begin, part.end]
    survey = found["survey"]
    if part.sensor:
        survey["sensors"] = {part.sensor: survey["sensors"][part.sensor]}
    if part.file:
        survey["file"] = str(Path(survey["file"]).with_name(f"{part.file}.hdf5"))
    return {**found, "survey": _absolute(survey, folder), "stages": stages}


def _absolute(node: Any, folder: Path) -> Any:
    if isinstance(node, dict):
        return {key: _absolute(value, folder) for key, value in node.items()}
    if isinstance(node, list):
        return [_absolute(value, folder) for value in node]
    return str((folder / node).resolve()) if isinstance(node, str) and node.startswith("../") else node


def tried(part: Part) -> dict[str, Any]:
    """What the loop says of a part."""
    with tempfile.TemporaryDirectory() as folder:
        recipe, output = Path(folder) / "part.yaml", Path(folder) / "out"
        recipe.write_text(yaml.safe_dump(recipe_of(part), sort_keys=False), encoding="utf-8")
        try:
            run_recipe(recipe, output)
        except MagtensorError as error:
            return {"part": list(part), "refused": str(error)}
        told = json.loads((output / "verdict.json").read_text(encoding="utf-8"))
    errors = {k: (told["error"]["held_out"].get(k) or {}).get("total_field_rms_nT") for k in ("before", "after")}
    return {
        "part": list(part),
        "floor": told["noise_floor_nT"],
        "determined": told.get("calibration", {}).get("determined", True),
        "adopted": told["adopted"],
        "errors": errors,
        "unexplained": told["unexplained"],
    }


def words(row: dict[str, Any]) -> list[str]:
    """The cells of a row of the table."""
    part = Part(*row["part"])
    unit, length = ("d", DAY_S) if part.recipe == "boulder" else ("h", HOUR_S) if part.recipe == "conrad" else ("s", 1)
    which = f"{part.begin / length:g} to {part.end / length:g} {unit}" if part.end else part.file[:2] or "all"
    name = f"{part.recipe.removeprefix('loop_')} {which}{', ' + part.sensor if part.sensor else ''}"
    if "refused" in row:
        return [name, "", "", f"refused: {row['refused'].split(':')[0].split(';')[0]}", ""]
    errors = [_rms(row["errors"][k]) for k in ("before", "after")]
    adopted = "; ".join(_effect(a) for a in row["adopted"]) or "nothing"
    left = row["unexplained"]
    adopted += "" if row["determined"] else " (sensors near nominal: the attitudes do not determine them)"
    stays = f"{left['excess_rms_nT']:.3g}" if left["present"] else "-"
    return [name, f"{row['floor']:.3g}", " -> ".join(errors), adopted, stays]


def _rms(block: dict[str, Any] | None) -> str:
    return "-" if not block or block.get("all") is None else f"{block['all']:.3g}"


def _effect(one: dict[str, Any]) -> str:
    settings = one["settings"]
    channel = f" of {settings['channel']}" if "channel" in settings else ""
    rivals, channels = one["indistinguishable_from"], one.get("channels_as_good", [])
    same = f", not told from {', '.join(rivals)}" if rivals else ""
    same += f", its channel not from {', '.join(channels)}" if channels else ""
    where = f" ({', '.join(one['sensors'])})" if one["sensors"] else ""
    return f"`{one['error_model']}`{channel}{where}{same}"


def table(rows: list[dict[str, Any]]) -> str:
    """All rows."""
    head = ["part", "noise floor, nT", "held-out rms of b - F, nT", "adopted", "unexplained, nT"]
    lines = [head, ["---"] * len(head), *(words(row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    def planned(only: str) -> list[Part]:
        return [part for part in parts() if only in part.recipe]

    title = "Parts of the measured recordings"
    trials.of_recordings(title, __doc__, planned, lambda row: row["part"], tried, words, table)


if __name__ == "__main__":
    main()
