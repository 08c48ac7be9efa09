"""Ways to load a survey in a test."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import xarray as xr
from hypothesis import settings
from survey_cases import array_variables

from magtensor.recipe.plan import readers
from magtensor.registry import Registry
from magtensor.survey.canonical import write_canonical
from magtensor.survey.model import Survey
from magtensor.survey.sections import SurveySection
from magtensor.survey.source import Source

# A first example pays for imports; what a test may take is the business of the whole run.
settings.register_profile("no_deadline", deadline=None)
settings.load_profile("no_deadline")


@pytest.fixture
def variables() -> dict[str, Any]:
    """Variables of `array_variables`, to be changed before a survey is made of them."""
    return array_variables()


@pytest.fixture(scope="session")
def registered() -> dict[str, Any]:
    """The installed readers."""
    return readers(Registry.load())


@pytest.fixture
def load_section(tmp_path: Path, registered: dict[str, Any]) -> Callable[..., Survey]:
    """Run the stage `load` on a survey section; its files are looked for in the test's folder."""
    from magtensor_stages import load

    def run(section: dict[str, Any], **options: Any) -> Survey:
        source = Source(SurveySection.model_validate_json(_json(section)), tmp_path, registered)
        return load(Survey(xr.DataTree(), source=source), **options)

    return run


@pytest.fixture
def load_variables(tmp_path: Path, load_section: Callable[..., Survey]) -> Callable[..., Survey]:
    """Write variables as a canonical file and run the stage `load` on it."""

    def run(variables: dict[str, Any], **options: Any) -> Survey:
        write_canonical(Survey.build(variables), tmp_path / "survey.nc")
        return load_section({"file": "survey.nc"}, **options)

    return run


def _json(section: dict[str, Any]) -> str:
    import json

    return json.dumps(section)
