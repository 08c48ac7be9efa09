"""The tables of the three papers, made again by the recipes in recipes/papers and printed beside the papers' figures.

python studies/papers.py [--quick] [--paper NAME]

A full run also writes docs/papers.md. It ends with an error where a figure differs by more than chance and no reason is
given.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the simulations run side by side

from pathlib import Path

import click
from paper_tables import chi2017, li2018, sui2017
from paper_tables.page import document, show
from rich.console import Console

PAPERS = {"chi2017": (chi2017, 100, 6), "li2018": (li2018, 20, 3), "sui2017": (sui2017, 60, 6)}

PAGE = Path(__file__).parents[1] / "docs" / "papers.md"
HEAD = """# The papers' tables, made again

    {command}

Every figure comes from simulated surveys (`recipes/scenarios/`) that went through the recipes in `recipes/papers/`.
For each row of a paper's table: the printed figure, the mean of our simulations, the scatter of one simulation, and
the difference in spreads. A spread is the standard deviation that the difference would have if nothing but chance and
the rounding of the print were at work. Where a figure differs by more than three spreads the reason stands below its
table; where it differs by less without a reason, the table says how many such figures there are and how many chance
puts there.
"""


@click.command(help=__doc__)
@click.option("--paper", "names", multiple=True, type=click.Choice(list(PAPERS)), help="only this one; may be repeated")
@click.option("--quick", is_flag=True, help="a few simulations only, for a smoke run")
@click.option("--workers", default=os.cpu_count() or 1, show_default=True, help="simulations at once")
@click.option("--output", type=click.Path(path_type=Path), help="write the tables as Markdown here")
def main(names: tuple[str, ...], quick: bool, workers: int, output: Path | None) -> None:
    if output is None and not names and not quick:
        output = PAGE
    console = Console(width=max(132, Console().width))
    comparisons = []
    for name in names or PAPERS:
        paper, usual, few = PAPERS[name]
        with console.status(f"simulating {name}"):
            found = paper.compared(few if quick else usual, workers)
        for comparison in found:
            show(console, comparison)
        comparisons += found
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        chosen = "".join(f" --paper {n}" for n in names) + (" --quick" if quick else "")
        output.write_text(document(comparisons, HEAD.format(command=f"python studies/papers.py{chosen}")), "utf-8")
    left = [figure for comparison in comparisons for figure in comparison.unexplained()]
    if left:
        raise click.ClickException("differences without a reason: " + "; ".join(left))


if __name__ == "__main__":
    main()
