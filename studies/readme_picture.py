"""Draw docs/closed_loop.svg: the demo's residual before and after the loop, `python studies/readme_picture.py`."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from magtensor.session import run_recipe
from magtensor.simulate.command import simulate_file

ROOT = Path(__file__).resolve().parent.parent


def main() -> None:
    """Simulate the demo survey, run the loop without and with adoption, draw both residuals."""
    with tempfile.TemporaryDirectory() as folder:
        survey = Path(folder) / "survey.h5"
        simulate_file(ROOT / "recipes/scenarios/undeclared_temperature.yaml", survey)
        recipe = ROOT / "recipes/closed_loop.yaml"
        runs = [
            run_recipe(recipe, Path(folder) / name, survey=survey, overrides=overrides).survey
            for name, overrides in (("before", ["stages.close_loop.most_effects=0"]), ("after", []))
        ]
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    for panel, run, title in zip(
        axes, runs, ("linear model alone", "after the loop added temperature_offset"), strict=True
    ):
        contrast = run.values("residual/contrast")
        for i, sensor in enumerate(run.sensors):
            panel.plot(run.time[::20] / 60, smooth(contrast[:, i, 0])[::20], lw=1, label=sensor)
        panel.set_title(f"{title}: {np.sqrt(np.mean(contrast**2)):.2f} nT rms", fontsize=10, loc="left")
        panel.set_ylabel("sensor - mean, x [nT]", fontsize=9)
        panel.grid(alpha=0.3)
    axes[1].set_ylim(axes[0].get_ylim())
    axes[1].set_xlabel("time [min]")
    axes[0].legend(ncols=4, fontsize=8, loc="upper right")
    figure.savefig(ROOT / "docs/closed_loop.svg", metadata={"Date": None})
    print("docs/closed_loop.svg")


def smooth(values: np.ndarray, width: int = 50) -> np.ndarray:
    """Running mean, so that the slow part shows."""
    return np.convolve(values, np.ones(width) / width, mode="same")


if __name__ == "__main__":
    main()
