"""From a scenario through a survey file and a recipe to a result, as the command line does it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtensor.preparing import empty_survey
from magtensor.recipe.plan import Plan, read_plan
from magtensor.recipe.source import load_yaml
from magtensor.runner import run
from magtensor.simulate import Simulated, simulate, write
from magtensor.survey.model import Survey
from magtensor.tensors import stored_assembly

Array = NDArray[np.float64]

RECIPES = Path(__file__).parents[2] / "recipes"
SIX = ("Bxx", "Bxy", "Bxz", "Byx", "Byy", "Byz")


def scenario(name: str) -> dict[str, Any]:
    """A shipped scenario, to be changed at will."""
    found: dict[str, Any] = load_yaml(RECIPES / "scenarios" / f"{name}.yaml").value
    return found


@contextmanager
def survey_file(changed: dict[str, Any]) -> Iterator[tuple[Simulated, Path]]:
    """The simulated survey, and the file it was written to while the context lasts."""
    made = simulate(changed)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "survey.h5"
        write(made, path)
        yield made, path


def planned(recipe: str, survey: Path, overrides: Sequence[str] = ()) -> Plan:
    """One of recipes/papers for a survey."""
    return read_plan(RECIPES / "papers" / f"{recipe}.yaml", survey=survey, overrides=overrides)


def calibrated(recipe: str, survey: Path, overrides: Sequence[str] = ()) -> Survey:
    """The survey after the recipe's last stage."""
    plan = planned(recipe, survey, overrides)
    return run(plan, empty_survey(plan)).survey


def trials(trial: Callable[[int], dict[str, Array]], seeds: Iterable[int], workers: int) -> dict[str, Array]:
    """Every figure of every seed's trial, name to (runs, ...)."""
    if workers > 1:
        with ProcessPoolExecutor(workers) as pool:
            done = list(pool.map(trial, seeds))
    else:
        done = [trial(seed) for seed in seeds]
    return {key: np.array([one[key] for one in done]) for key in done[0]}


def total_rms(b: Array, total_field: float) -> Array:
    """(S,) nT: RMS of |b| - F."""
    return rms(np.linalg.norm(b, axis=2) - total_field)


def tensor_rms(survey: Survey, b: Array) -> Array:
    """(6,) nT/m: RMS of the differences over the baseline, Bxy and Byx apart, of fields (N, 4, 3) nT."""
    tensor = stored_assembly(survey).apply(b)
    return rms(tensor[:, [0, 0, 0, 1, 1, 1], [0, 1, 2, 0, 1, 2]])


def true_field(made: Simulated) -> Array:
    """(N, 4, 3) nT in the platform frame: the raw output corrected with the true parameters; its errors are noise."""
    inverse = np.linalg.inv(made.truth.matrix)
    out: Array = np.einsum("sij,nsj->nsi", inverse, made.b_raw - made.truth.offset)
    return out


def rms(values: Array) -> Array:
    """Root mean square over the samples (N, ...)."""
    out: Array = np.sqrt(np.mean(np.square(values), axis=0))
    return out
