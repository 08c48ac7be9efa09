"""The example of an error model of one's own: as a package of two files, and as one file in a folder."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
from effect_cases import TUMBLING, excitation, explained, per_axis

from magtensor.loop.checker import check_error_model
from magtensor.registry import Registry
from magtensor.simulate import simulate

EXAMPLES = Path(__file__).parents[2] / "examples"
PACKAGE = EXAMPLES / "feedback_heating"
FOLDER = EXAMPLES / "plugins"


def test_the_two_forms_are_one_text() -> None:
    package = (PACKAGE / "magtensor_feedback_heating.py").read_text()
    assert (FOLDER / "feedback_heating.py").read_text() == package
    assert sorted(f.name for f in PACKAGE.iterdir() if f.suffix in (".py", ".toml")) == [
        "magtensor_feedback_heating.py",
        "pyproject.toml",
    ]


def test_a_file_in_a_folder_is_an_error_model() -> None:
    registry = Registry.load([FOLDER])
    component = registry.find("error_model", "feedback_heating")
    assert registry.origin["error_model", "", "feedback_heating"].file == FOLDER / "feedback_heating.py"
    assert check_error_model(component) == []


def test_its_regressors_are_the_lagged_squares() -> None:
    # a reference of its own: tau y' + y = u stepped in hundredths of a sample interval
    model = Registry.load([FOLDER]).find("error_model", "feedback_heating").function
    survey = simulate(TUMBLING | {"channels": {}, "logging": {}})
    x = excitation(survey)
    fine = np.linspace(0.0, x.duration, 100 * (len(x.time) - 1) + 1)
    heat = np.empty(x.output.shape)
    for s, a in np.ndindex(4, 3):
        u = np.interp(fine, x.elapsed, (x.output[:, s, a] / 50000.0) ** 2)
        y, course = u[0], np.empty_like(u)
        for k, value in enumerate(u):
            y += (value - y) * (fine[1] / 20.0)
            course[k] = y
        heat[:, s, a] = course[::100]
    true = np.random.default_rng(1).standard_normal((4, 3))
    fit = explained(model(x, tau_s=20.0), x, heat * true)
    assert fit.left < 2e-3  # Euler's steps: 0.001 s in 20
    np.testing.assert_allclose(per_axis(fit, survey.sensors), true, atol=2e-3)


def test_the_package_gives_it_by_its_entry_point(tmp_path: Path) -> None:
    # what an installer makes of pyproject.toml, written here: no build tools needed
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    place = tmp_path / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    place.mkdir()
    (place / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    points = "".join(f"{k} = {v}\n" for k, v in project["entry-points"]["magtensor"].items())
    (place / "entry_points.txt").write_text(f"[magtensor]\n{points}")
    (tmp_path / "magtensor_feedback_heating.py").write_text((PACKAGE / "magtensor_feedback_heating.py").read_text())
    ask = "from magtensor.registry import Registry; r = Registry.load(); r.check(); "
    ask += "print(r.origin['error_model', '', 'feedback_heating'].origin)"
    paths = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    told = subprocess.run(
        [sys.executable, "-c", ask], check=True, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": paths}
    )
    assert told.stdout.strip() == "magtensor-feedback-heating 0.1.0 (feedback_heating)"
