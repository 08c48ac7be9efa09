"""The rows of the loop's study as text: one line each, and the page with its tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from loop_surveys import model_of

Row = dict[str, Any]
ORACLE_LEVEL = 0.005  # the loop's family-wise level, for the one test of the oracle
FEW = 50  # surveys below which a table says itself that it is a small sample
KEY = ("motion", "noise", "amplitude", "rate_Hz")


def line(row: Row) -> str:
    """A trial on the terminal."""
    what = f"{row['effect']}, {row['amplitude']:g} x noise" if row["effect"] else "clean"
    return f"{what}, {row['motion']}, {row['noise']}, seed {row['seed']}: {said(row)}"


def said(row: Row) -> str:
    """The outcome with what was adopted and where the effect was lost."""
    rivals = f" (or {', '.join(row['rivals'])})" if row.get("rivals") else ""
    adopted = f": {', '.join(row['adopted'])}{rivals}" if row.get("adopted") else ""
    reason = f"; {row['why']}" if "why" in row else ""
    left = f"; left: {row['left']}" if row["outcome"] == "told" else ""
    return f"{row['outcome']}{adopted}{reason}{left}"


def share(hits: int, count: int) -> str:
    """A share with its exact 95 % interval (Clopper and Pearson 1934)."""
    from scipy.stats import binomtest

    if not count:
        return "-"
    low, high = binomtest(hits, count).proportion_ci(0.95, method="exact")
    return f"{hits}/{count} ({100 * low:.0f}-{100 * high:.0f} %)"


def seen(row: Row) -> bool:
    """Whether the oracle finds the effect."""
    return row["oracle"] is not None and row["oracle"] < ORACLE_LEVEL


def affordable(row: Row) -> bool:
    """Whether the oracle finds the effect where it pays for all that the loop tries."""
    return row["oracle"] is not None and row["oracle"] * row["tests"] < ORACLE_LEVEL


def by_rival(row: Row) -> bool:
    """Whether the effect was adopted under the name of a model that it is declared indistinguishable from."""
    return row["outcome"] == "right" and model_of(row["effect"]) not in row["adopted"]


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Lines of Markdown."""
    yield f"| {' | '.join(header)} |"
    yield f"|{'---|' * len(header)}"
    for cells in rows:
        yield f"| {' | '.join(cells)} |"
    yield ""


def groups(rows: Sequence[Row], *keys: str) -> list[tuple[tuple[Any, ...], list[Row]]]:
    """Rows that agree in some columns, in the order of their first."""
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), []).append(row)
    return list(found.items())


def among(outcome: str) -> Callable[[Sequence[Row]], str]:
    """The share of an outcome."""
    return lambda rows: share(sum(r["outcome"] == outcome for r in rows), len(rows))


def clean_surveys(rows: Sequence[Row]) -> Iterator[str]:
    """What the loop says of surveys without an effect."""
    yield "## Clean surveys"
    yield ""
    if not rows:
        return
    lines = [
        [motion, noise, among("wrong")(own), among("told")(own)]
        for (motion, noise), own in groups(rows, "motion", "noise")
    ]
    lines.append(["all", "", among("wrong")(rows), among("told")(rows)])
    yield from table(["motion", "noise", "something adopted", "nothing adopted, but something told"], lines)
    yield from (f"- {line(row)}" for row in rows if row["outcome"] != "clean")
    yield ""


def power(rows: Sequence[Row]) -> Iterator[str]:
    """The loop beside the oracle."""
    yield "## Surveys with one effect"
    yield ""
    if not rows:
        return
    lines = []
    for (motion, noise, amplitude), own in sorted(groups(rows, "motion", "noise", "amplitude"), key=lambda g: g[0][2]):
        known = [r for r in own if r["oracle"] is not None]
        found = [r for r in own if seen(r)]
        paid = [r for r in own if affordable(r)]
        cells = [f"{amplitude:g} x noise", motion, noise, share(len(found), len(known)), named_of(found)]
        cells += [share(len(paid), len(known)), named_of(paid)]
        lines.append(cells + [among(o)(own) for o in ("right", "more", "wrong")])
        lines[-1] += [str(sum(r["outcome"] == o for r in own)) for o in ("told", "missed")]
        lines[-1].append(str(sum(by_rival(r) for r in own)))
    header = ["amplitude", "motion", "noise", "oracle finds it", "of these the loop names"]
    header += ["oracle that pays finds it", "of these the loop names", "right", "more", "wrong"]
    yield from table([*header, "told", "missed", "right, but adopted as a rival"], lines)


def named_of(rows: Sequence[Row]) -> str:
    """The share of them that the loop names."""
    return share(sum(r["outcome"] in ("right", "more") for r in rows), len(rows))


def outcome(row: Row) -> str:
    """One cell."""
    rival = f" ({', '.join(row['adopted'])})" if by_rival(row) or row["outcome"] == "wrong" else ""
    mark = "" if row["oracle"] is None or affordable(row) else "+" if seen(row) else "*"
    return f"{row['outcome']}{rival}{mark}"


def by_effect(rows: Sequence[Row]) -> Iterator[str]:
    """Each effect's outcomes."""
    yield "## Effect by effect"
    yield ""
    yield (
        "In brackets: what was adopted, where it is not the effect itself. An asterisk: the oracle does not find it "
        "either; a plus: not the one that pays for what was tried. A dash: not run, or no such survey can be simulated "
        "(delays of a minute, or longer than the survey, to be as large as asked)."
    )
    yield ""
    columns = sorted({(r["motion"], r["noise"], r["amplitude"]) for r in rows}, key=lambda c: (c[1], c[0], c[2]))
    lines = []
    for (effect,), own in groups(rows, "effect"):
        cells = [effect]
        for column in columns:
            here = [r for r in own if (r["motion"], r["noise"], r["amplitude"]) == column]
            words = [outcome(r) for r in here]
            cells.append(", ".join(words) or "-")
        lines.append(cells)
    yield from table(["effect", *(f"{m}, {n}, {a:g} x" for m, n, a in columns)], lines)


def together(rows: Sequence[Row]) -> Iterator[str]:
    """Surveys with more than one effect."""
    yield "## Surveys with several effects"
    yield ""
    if not rows:
        return
    words = ("right", "more", "part", "wrong")
    lines = []
    for count in sorted({row["effect"].count("+") + 1 for row in rows}):
        own = [row for row in rows if row["effect"].count("+") + 1 == count]
        lines.append([str(count), *(among(o)(own) for o in words)])
        lines[-1] += [str(sum(r["outcome"] == o for r in own)) for o in ("told", "missed")]
    yield from table(["effects", *words, "told", "missed"], lines)


def losses(rows: Sequence[Row]) -> Iterator[str]:
    """Every effect that the loop did not name rightly, and where it lost it."""
    yield "## What was lost, and where"
    yield ""
    yield from (f"- {line(row)}" for row in rows if row["outcome"] not in ("right", "cannot be"))
    yield ""


def page(docstring: str, command: str, rows: Sequence[Row], not_made: int) -> str:
    """The whole page; `not_made`: trials that the time given did not suffice for."""
    rate = " and ".join(f"{r:g}" for r in sorted({row["rate_Hz"] for row in rows}))
    ran = [row for row in rows if row["outcome"] != "cannot be"]
    clean, several = [r for r in ran if not r["effect"]], [r for r in ran if "+" in r["effect"]]
    effects = [r for r in ran if r["effect"] and "+" not in r["effect"]]
    seeds = len({r["seed"] for r in effects})
    cells = groups(effects, *KEY)
    text = ["# The power of the loop", "", docstring.split("\n\n", 2)[2].rsplit("\n\n", 1)[0], ""]
    counts = f"{len(clean)} clean surveys, {len(effects)} with one effect, {len(several)} with several"
    text += [f"`{command}` ({rate} samples a second; {counts})", ""]
    if not_made:
        text += [
            f"Not complete: {not_made} more trials of this command were not made in the time given (`--seconds`).",
            "",
        ]
    if cells and min(len(own) for _, own in cells) < FEW:
        text.append(
            f"A small sample: {seeds} survey{'s' if seeds > 1 else ''} of each effect in each cell. An interval counts "
            "the effects of its cell as if they were draws of one kind; of a single effect a single survey says little."
        )
        text.append("")
    every = [
        *clean_surveys(clean),
        *power(effects),
        *by_effect(effects),
        *together(several),
        *losses([*effects, *several]),
    ]
    return "\n".join([*text, *every]).rstrip() + "\n"
