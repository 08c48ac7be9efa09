"""What a plan promises: the recipe's order, the data flow checked, and a resolved recipe that gives itself again."""

from __future__ import annotations

import json

import pytest

from magtensor.recipe.plan import plan, read_plan
from magtensor.recipe.source import Document

PLUGIN = '''
@stage(needs=("b_raw",), gives=("one",))
def first(survey):
    """Give one."""
    return {"one": ((), 1.0, {})}

@stage(needs=("one",), gives=("two", "current_motor"))
def second(survey):
    """Give two."""
    return {"two": ((), 2.0, {}), "current_motor": (("time",), np.zeros(4), {})}

@stage(needs=("current_*",), gives=("three",))
def third(survey, *, method: MethodChoice = "plain",
          pair: Annotated[tuple[float, ...], Field(description="p")] = (1, 2),
          word: Annotated[str | None, Field(description="w")] = None,
          level: Annotated[float, Field(description="l")] = float("inf"),
          metrics: MetricsChoice = None):
    """Need any current."""
    return {"three": ((), 3.0, {})}

@method("third")
def plain(x, *, steps: Annotated[int, Field(description="s")] = 3,
          tiny: Annotated[float, Field(description="t")] = 1e-7):
    """Plainly."""

@metric()
def noise(survey, *, band: Annotated[float, Field(description="Hz")] = 1.0):
    """Noise."""

from magtensor.components import Declares

@stage(declares=lambda options: Declares(needs=(options["of"],), gives=("four",)))
def fourth(survey, *, of: Annotated[str, Field(description="which variable")]):
    """Need what the option says."""
    return {"four": ((), 4.0, {})}
'''


@pytest.fixture
def own(bench):
    bench.plugin(PLUGIN)
    return bench


def test_the_list_alone_decides_the_order(own):
    names = [s.name for s in own.plan("  - start\n  - first\n  - second\n  - third\n").stages]
    assert names == ["start", "first", "second", "third"]
    names = [s.name for s in own.plan("  - start\n  - first\n  - first\n  - second\n  - first\n").stages]
    assert names == ["start", "first", "first", "second", "first"]


@pytest.mark.parametrize(
    ("stages", "refusals"),
    [
        (["first"], ["stages[0]: first needs b_raw, which no stage before it gives; given by load, start"]),
        (["start", "second", "first"],
         ["stages[1]: second needs one, which no stage before it gives; given by first"]),
        (["start", "third", "first", "second"],
         ["stages[1]: third needs current_*, which no stage before it gives; given by load, second"]),
        (["start", "fourth: {of: two}", "fourth: {of: nothing}"],
         ["stages[1]: fourth needs two, which no stage before it gives; given by second",
          "stages[2]: fourth needs nothing, which no stage before it gives"]),
    ],
)  # fmt: skip
def test_data_flow_is_checked_before_data_are_read(own, stages, refusals):
    own.survey.unlink()
    found = own.mistakes("".join(f"  - {s}\n" for s in stages))
    assert [line.split(": ", 1)[1] for line in found] == refusals


def test_a_mistake_in_a_stage_brings_no_false_ones_of_others(own):
    found = own.mistakes("  - start: {valu: 1}\n  - first\n  - second\n")
    assert len(found) == 1


def test_a_loader_may_give_what_a_later_stage_needs(own):
    assert len(own.plan("  - load\n  - third\n").stages) == 2


STAGES = (
    "  - start: {value: 2}\n  - first\n  - second\n  - third: {tiny: 1e-9, metrics: [noise], pair: [3]}\n"
    "  - fourth: {of: two}\n  - third\n"
)


def again(planned):
    """The plan of a resolved recipe after it was stored as JSON."""
    stored = json.loads(json.dumps(planned.resolved()))
    return plan(Document(stored, "stored", {}, planned.folder))


@pytest.mark.parametrize(
    "top",
    [
        "plugins: [own.py]", "plugins: own.py\ndescription: 'what: it is for'\nauthors: [A. Ünal, 'B: C']",
        "plugins: [own.py, magtensor]\nreferences: one\ndescription: ''", "plugins: [.]",
    ],
)  # fmt: skip
def test_a_resolved_recipe_is_a_fixed_point(own, top):
    planned = own.plan(STAGES, top=top)
    resolved = planned.resolved()
    assert again(planned).resolved() == resolved
    assert again(again(planned)).resolved() == resolved
    assert [dict(s.described) for s in again(planned).stages] == [dict(s.described) for s in planned.stages]


def test_a_resolved_recipe_holds_every_default(own):
    stages = own.plan(STAGES).resolved()["stages"]
    assert stages[3]["third"] == {
        "metrics": {"noise": {"band": 1.0}}, "method": "plain", "steps": 3, "tiny": 1e-9, "pair": [3.0], "word": None,
        "level": float("inf"),
    }  # fmt: skip
    assert set(stages[5]["third"]["metrics"]) >= {"noise", "flagged"}, "all that are installed, by name"


def test_plugin_folders_of_the_command_line_are_resolved_once(own, tmp_path):
    folder = tmp_path / "more"
    extra = "from magtensor import stage\n@stage()\ndef extra(survey):\n    '''Extra.'''\n"
    own.plugin(extra, "more/extra.py", head="")
    path = own.recipe("  - start\n  - extra\n")
    planned = read_plan(path, plugin_folders=[folder])
    assert planned.resolved()["plugins"] == [str(tmp_path / "own.py"), str(folder)]
    assert again(planned).resolved() == planned.resolved()
    stored = Document(planned.resolved(), "stored", {}, planned.folder)
    assert plan(stored, plugin_folders=[folder]).resolved() == planned.resolved()


def test_input_takes_the_place_of_the_recipes_files(own, tmp_path):
    path = own.recipe("  - start\n")
    other = tmp_path / "other.h5"
    assert read_plan(path, survey=other).resolved()["survey"]["file"] == str(other)
    path.write_text("title: t\nplugins: own.py\nsurvey: {files: 'day*.h5', order: time}\nstages: [start]\n")
    survey = read_plan(path, survey=other).resolved()["survey"]
    assert (survey["file"], survey.get("files"), survey["order"]) == (str(other), None, "time")
    path.write_text("title: t\nplugins: own.py\nstages: [start]\n")
    assert read_plan(path).survey is None
    assert read_plan(path, survey=other).resolved()["survey"]["file"] == str(other)
