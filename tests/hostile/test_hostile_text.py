"""CSV surveys: the same array as text, damaged as text gets damaged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_surveys import Contents

NAMES = [f"b{s}{a}" for s in range(1, 5) for a in "xyz"]
SENSORS = {f"S{s}": {"from": [f"b{s}x", f"b{s}y", f"b{s}z"], "units": "nT"} for s in range(1, 5)}
Lines = list[str]


def table(contents: Contents) -> Lines:
    rows = np.column_stack([contents.time, contents.b.reshape(len(contents.time), -1)])
    return [",".join(["t", *NAMES]), *(",".join(f"{x:.3f}" for x in row) for row in rows)]


def section(folder: Path, contents: Contents) -> dict[str, Any]:
    base = np.column_stack([contents.values["reference/time"], contents.reference])
    text = "\n".join(["t,F", *(f"{t:.3f},{f:.2f}" for t, f in base)])
    (folder / "base.csv").write_text(text + "\n", encoding="utf-8")
    positions = contents.values["position"]
    time = {"from": "t", "units": "s", "epoch": "2026-03-21T09:00:00Z"}
    sensors = {n: {**s, "position": p.tolist()} for (n, s), p in zip(SENSORS.items(), positions, strict=True)}
    return {
        "file": "log.csv",
        "reader": "text",
        "time": time,
        "sensors": sensors,
        "reference": {"file": "base.csv", "time": time, "total_field": {"from": "F", "units": "nT"}},
    }


def cell(row: int, column: int, value: str) -> Callable[[Lines], Lines]:
    def change(lines: Lines) -> Lines:
        cells = lines[row].split(",")
        cells[column] = value
        return [*lines[:row], ",".join(cells), *lines[row + 1 :]]

    return change


def thousandth(line: str) -> str:
    time, *field = line.split(",")
    return ",".join([time, *(f"{float(x) / 1e3:.6f}" for x in field)])


REFUSED: dict[str, tuple[Callable[[Lines], Any], str]] = {
    "empty": (lambda lines: "", r"log\.csv.*empty"),
    "header alone": (lambda lines: lines[:1], r"log\.csv"),
    "one row": (lambda lines: lines[:2], r"log\.csv"),
    "nine rows": (lambda lines: lines[:10], "9 samples"),
    "no header": (lambda lines: lines[1:], r"log\.csv"),
    "another header": (lambda lines: ["a" + lines[0], *lines[1:]], r"log\.csv: there is no"),
    "a column less": (lambda lines: [x.rsplit(",", 1)[0] for x in lines], r"there is no b4z \(did you mean b4y"),
    "decimal commas": (lambda lines: [x.replace(",", ";").replace(".", ",") for x in lines], r"log\.csv"),
    "binary": (lambda lines: bytes(range(256)) * 40, r"log\.csv"),
    "zeros": (lambda lines: bytes(4000), r"log\.csv"),
    "words": (lambda lines: [lines[0], *(",".join(["x"] * 13) for _ in lines[1:])], r"log\.csv"),
    "a time twice": (lambda lines: [*lines[:50], lines[49], *lines[50:]], "same time as the one before"),
    "backwards": (lambda lines: [lines[0], *lines[:0:-1]], "the times run backwards"),
    "microtesla": (lambda lines: [lines[0], *map(thousandth, lines[1:])], "looks like uT labelled nT"),
}


@pytest.mark.parametrize("recipe", ["chi", "li", "joint"])
@pytest.mark.parametrize("name", REFUSED)
def test_refused(bench: Any, tmp_path: Path, sound_contents: Contents, name: str, recipe: str) -> None:
    change, message = REFUSED[name]
    damaged = change(table(sound_contents))
    content = "\n".join(damaged).encode() if isinstance(damaged, list) else damaged
    (tmp_path / "log.csv").write_bytes(content.encode() if isinstance(content, str) else content)
    bench(recipe, tmp_path / "log.csv", survey_section=section(tmp_path, sound_contents)).refused(message)


@pytest.mark.parametrize("recipe", ["chi", "li", "joint"])
def test_survived(bench: Any, tmp_path: Path, sound_contents: Contents, truth: np.ndarray, recipe: str) -> None:
    """Empty and unreadable cells, a row cut short at the end, semicolons, a byte-order mark, Windows line ends."""
    lines = table(sound_contents)
    for change in (cell(40, 3, ""), cell(41, 3, "NaN"), cell(80, 5, "1e999")):
        lines = change(lines)
    lines[-1] = lines[-1][:30]
    (tmp_path / "log.csv").write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines).replace(",", ";").encode())
    outcome = bench(recipe, tmp_path / "log.csv", survey_section=section(tmp_path, sound_contents)).succeeded()
    mean, difference, used = outcome.error_against(truth, sound_contents.time)
    assert mean < 0.25 * 1.25
    assert difference < 0.433 * 1.25
    np.testing.assert_array_equal(np.flatnonzero(~used), [39, 40, 79, 499])
