"""What all tests share."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

# a machine that others use too makes examples slowly
settings.register_profile("seeded", derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("seeded")
os.environ["MAGTENSOR_PROCESSES"] = "1"  # the tests themselves share the cores


@pytest.fixture(autouse=True)
def _pictures_where_they_are_the_subject(request: pytest.FixtureRequest) -> Iterator[None]:
    """Reports of this process have no pictures, which take longer than most runs, but in tests marked `pictures`."""
    if request.node.get_closest_marker("pictures"):
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("magtensor.report.gallery.gallery", lambda content: [])
        yield
