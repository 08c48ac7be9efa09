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


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--part", default="1/1", metavar="K/N", help="run the Kth of N parts of the test files")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Every Nth file, by name: parts that are run one after the other leave none out."""
    part, parts = map(int, config.getoption("--part").split("/"))
    if not 1 <= part <= parts:
        raise pytest.UsageError(f"--part {part}/{parts}: there are parts 1 to {parts}")
    files = sorted({item.path for item in items})
    chosen = set(files[part - 1 :: parts])
    config.hook.pytest_deselected(items=[item for item in items if item.path not in chosen])
    items[:] = [item for item in items if item.path in chosen]


@pytest.fixture(autouse=True)
def _pictures_where_they_are_the_subject(request: pytest.FixtureRequest) -> Iterator[None]:
    """Reports of this process have no pictures, which take longer than most runs, but in tests marked `pictures`."""
    if request.node.get_closest_marker("pictures"):
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("magtensor.report.gallery.gallery", lambda content: [])
        yield
