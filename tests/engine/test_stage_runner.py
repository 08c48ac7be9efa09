"""What the runner allows a stage, and what it records of it."""

from __future__ import annotations

import numpy as np
import pytest

from magtensor.errors import DataError, UsageError
from magtensor.preparing import empty_survey
from magtensor.runner import run

PLUGIN = '''
from magtensor.survey.flags import Flag
SEEN = []

@stage(needs=("b_raw",), uses=("temperature",), gives=("one",), may_give=("perhaps_*",))
def plain(survey, *, act: Annotated[str, Field(description="what to do")] = ""):
    """Do what the option says."""
    SEEN.append(act)
    one = {"one": (("time",), np.ones(4), {})}
    if act == "reads undeclared":
        survey.values("position")
    if act == "reads hidden":
        survey.values("secret")
    if act == "asks":
        assert "secret" not in survey and "secret" not in survey.paths() and survey.matching("sec*") == []
        assert "b_raw" in survey and list(survey) == ["axis", "b_raw", "sensor", "time"]
    if act == "writes undeclared":
        return one | {"two": (("time",), np.ones(4), {})}
    if act == "forgets":
        return {"perhaps_x": (("time",), np.ones(4), {})}
    if act == "perhaps":
        return one | {"perhaps_x": (("time",), np.ones(4), {})}
    if act == "nothing":
        return None
    if act == "in place":
        survey.values("b_raw")[:] = 0.0
    if act == "in place through xarray":
        survey["b_raw"][0, 0, 0] = 0.0
    if act == "reads":
        survey.values("b_raw"), survey.sensors, survey.time
    if act == "bug":
        raise ZeroDivisionError("a slip of the pen")
    if act == "leaves":
        import sys
        sys.exit(0)
    if act == "refuses":
        raise DataError("the field is too weak", where="sensor S1")
    if act == "shape":
        return {"one": (("time",), np.ones(7), {})}
    if act == "flags":
        mask = np.zeros((4, 2), dtype=bool)
        mask[1, 0] = True
        return one | {"good": (("time", "sensor"), ~mask, {}), "flags": []}
    return one

@stage(needs=("b_raw",), gives=("secret",))
def hide(survey):
    """Give a secret."""
    return {"secret": (("time",), np.zeros(4), {})}

@stage(gives=("time", "sensor", "axis", "b_raw", "position"))
def half_loader(survey):
    """Load without what was promised."""
    from magtensor_stages.load import load
    return start(survey)
'''


@pytest.fixture
def own(bench):
    bench.plugin(PLUGIN)
    return bench


def running(bench, stages: str):
    planned = bench.plan(stages)
    return run(planned, empty_survey(planned))


@pytest.mark.parametrize(
    ("act", "words"),
    [
        ("reads undeclared", "stage plain reads position, which it declares neither in needs nor in uses"),
        ("reads hidden", "stage plain reads secret, which it declares neither in needs nor in uses"),
        ("writes undeclared", "stage plain gives two, which it does not declare"),
        ("forgets", "stage plain declares that it gives one, but did not"),
        ("nothing", "stage plain returned NoneType, not a mapping"),
    ],
)
def test_a_stage_that_breaks_its_declaration_is_stopped(own, act, words):
    with pytest.raises(UsageError) as caught:
        running(own, f"  - start\n  - hide\n  - plain: {{act: {act}}}\n")
    assert words in str(caught.value)


@pytest.mark.parametrize("act", ["asks", "perhaps", "reads", ""])
def test_a_stage_within_its_declaration(own, act):
    done = running(own, f"  - start\n  - hide\n  - plain: {{act: {act!r}}}\n")
    assert ("perhaps_x" in done.survey) == (act == "perhaps")
    assert "secret" in done.survey and "one" in done.survey


@pytest.mark.parametrize("act", ["in place", "in place through xarray"])
def test_a_stage_cannot_change_the_survey_in_place(own, act):
    with pytest.raises(ValueError, match=r"read-only|destination is a view"):
        running(own, f"  - start\n  - plain: {{act: {act}}}\n")


def test_a_loader_keeps_its_promise_too(own):
    with pytest.raises(UsageError, match="half_loader declares that it gives position, but did not"):
        running(own, "  - half_loader\n")


def test_records_in_order_with_what_was_read_and_written(own):
    done = running(own, "  - start: {value: 3}\n  - plain: {act: reads}\n  - hide\n  - plain\n")
    assert [r.name for r in done.records] == ["start", "plain", "hide", "plain"]
    assert [r.wrote for r in done.records] == [("axis", "b_raw", "sensor", "time"), ("one",), ("secret",), ("one",)]
    assert [r.read for r in done.records] == [(), ("b_raw", "sensor", "time"), (), ()]
    assert [r.options for r in done.records] == [{"value": 3.0}, {"act": "reads"}, {}, {"act": ""}]
    started = [r.started for r in done.records]
    assert started == sorted(started)
    assert all(r.duration_s >= 0 for r in done.records)


def test_a_bug_names_its_stage_and_options_and_stops_the_rest(own):
    planned = own.plan("  - start\n  - plain: {act: bug}\n  - plain: {act: never}\n")
    seen = planned.stages[1].component.function.__globals__["SEEN"]  # the module is shared while its file is the same
    seen.clear()
    with pytest.raises(ZeroDivisionError) as caught:
        run(planned, empty_survey(planned))
    assert "in stage plain, options {'act': 'bug'}" in caught.value.__notes__
    assert seen == ["bug"]


def test_a_stage_cannot_end_the_program(own):
    """A plugin's sys.exit(0) must not look like a run that went well."""
    with pytest.raises(RuntimeError, match="stage plain"):
        running(own, "  - start\n  - plain: {act: leaves}\n")
    assert own.folder.joinpath("out").exists() is False


def test_a_shape_that_does_not_fit_is_the_plugins_bug(own):
    with pytest.raises(ValueError, match="time"):
        running(own, "  - start\n  - plain: {act: shape}\n")


def test_missing_data_are_told_when_they_are_known_to_be_missing(own):
    own.plugin(PLUGIN.replace('uses=("temperature",), ', "").replace('needs=("b_raw",)', 'needs=("temperature",)', 1))
    with pytest.raises(DataError, match="stage plain needs temperature, which this survey does not have"):
        running(own, "  - start\n  - plain\n")


def test_flagged_samples_are_out_of_use_for_later_stages(own):
    own.plugin(PLUGIN.replace('may_give=("perhaps_*",)', 'may_give=("perhaps_*", "good")'))
    done = running(own, "  - start\n  - plain: {act: flags}\n")
    np.testing.assert_array_equal(done.survey.good, [True, False, True, True])
    np.testing.assert_array_equal(done.survey.good_by_sensor[1], [False, True])


def test_progress_names_each_stage_before_it_runs(own):
    planned = own.plan("  - start\n  - hide\n")
    told: list[str] = []
    run(planned, empty_survey(planned), progress=told.append)
    assert told == ["start", "hide"]
