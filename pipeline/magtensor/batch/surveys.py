"""Which surveys a batch is to run, and what their folders are called."""

from __future__ import annotations

import glob
import hashlib
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

NOT_SURVEYS = (".calibrated.nc",)  # what `magtensor apply` leaves beside a survey


@dataclass(frozen=True)
class Wanted:
    """A survey that was asked for: its absolute path, and why it cannot be read ("" if nothing is known yet)."""

    path: Path
    problem: str = ""


def wanted_surveys(names: Iterable[Path], endings: Sequence[str]) -> list[Wanted]:
    """Files, folders and glob patterns as surveys, in the order given, each once.

    A folder stands for the files in it (not below it) with one of the `endings`; a name that leads to nothing is kept
    with its problem, for one missing survey must not stop the others.
    """
    found: dict[Path, Wanted] = {}
    for name in names:
        for one in _expanded(Path(os.path.abspath(Path(name).expanduser())), endings):
            found.setdefault(one.path.resolve(), one)
    return list(found.values())


def _expanded(name: Path, endings: Sequence[str]) -> list[Wanted]:
    if name.is_dir():
        inside = [Wanted(f) for f in sorted(name.iterdir()) if _looks_like_survey(f, endings)]
        known = ", ".join(sorted(endings))
        return inside or [Wanted(name, f"no survey in this folder (file endings looked for: {known})")]
    if name.exists():
        return [Wanted(name)]
    if glob.has_magic(str(name)):
        fitting = [Path(f) for f in sorted(glob.glob(str(name), recursive=True))]
        inside = [one for f in fitting for one in (_expanded(f, endings) if f.is_dir() else [Wanted(f)])]
        return inside or [Wanted(name, "no file fits this pattern")]
    return [Wanted(name, "no such file")]


def _looks_like_survey(file: Path, endings: Sequence[str]) -> bool:
    name = file.name.lower()
    return (
        not name.startswith(".")
        and name.endswith(tuple(e.lower() for e in endings))
        and not name.endswith(NOT_SURVEYS)
        and file.is_file()
    )


def folder_names(paths: Iterable[Path], recorded: Mapping[Path, str], reserved: Iterable[str] = ()) -> dict[Path, str]:
    """A folder name for each survey: its stem, or a longer name where several share one.

    What an earlier batch `recorded` stays; the rest depends on the set of paths alone, not on their order. Where stems
    clash the file's ending is added, then the folders above it, one by one, until the names differ.
    """
    found = {p: recorded[p] for p in paths if p in recorded}
    taken = {n.casefold() for n in (*recorded.values(), *reserved)}
    left = [p for p in paths if p not in found]
    for candidates in _namings(left):
        names = {p: candidates[p] for p in left}
        count = Counter(n.casefold() for n in names.values())
        settled = {p: n for p, n in names.items() if count[n.casefold()] == 1 and n.casefold() not in taken}
        found |= settled
        taken |= {n.casefold() for n in settled.values()}
        left = [p for p in left if p not in settled]
    return found


def _namings(paths: Sequence[Path]) -> Iterable[dict[Path, str]]:
    yield {p: p.stem for p in paths}
    yield {p: p.name for p in paths}
    for depth in range(1, max((len(p.parts) for p in paths), default=0) - 1):
        yield {p: "-".join([*p.parts[1:-1][-depth:], p.stem]) for p in paths}
    yield {p: f"{p.stem}-{hashlib.sha256(os.fsencode(p)).hexdigest()[:16]}" for p in paths}
