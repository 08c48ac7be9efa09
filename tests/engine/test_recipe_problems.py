"""Every mistake in a recipe at once, each with file, line and what would be right."""

from __future__ import annotations

import pytest

from magtensor.errors import UsageError
from magtensor.recipe.plan import read_plan

PLUGIN = '''
@stage(needs=("b_raw",), gives=("calibration/fit",))
def fit(
    survey, *, method: MethodChoice = "plain",
    limit: Annotated[float, Field(gt=0, description="largest residual, nT")] = 5.0,
    mode: Annotated[Literal["fast", "exact"], Field(description="how")] = "fast",
    sensors: Annotated[list[str] | None, Field(description="which")] = None,
):
    """Fit."""

@method("fit")
def plain(raw, *, steps: Annotated[int, Field(ge=1, description="iterations")] = 3):
    """Plainly."""

@method("fit")
def robust(raw, *, cut: Annotated[float, Field(description="where to cut")] = 2.5):
    """Robustly."""

@stage(needs=("b_raw",), gives=("qc/own",))
def judge(survey, *, metrics: MetricsChoice = None):
    """Judge."""

@metric()
def noise(survey, *, band: Annotated[float, Field(description="Hz")] = 1.0):
    """Noise."""
'''


@pytest.fixture
def own(bench):
    bench.plugin(PLUGIN)
    return bench


def test_all_mistakes_at_once(own):
    """Seven mistakes in six stages: seven lines, in the order of the file."""
    stages = """  - start: {valu: 2.0}
  - fit:
      method: robust
      limit: -1
      mode: exakt
  - fti
  - judge:
      metrics: {noise: {band: wide}, nose: {}}
  - fit: {steps: many}
"""
    assert own.mistakes(stages) == [
        "recipe.yaml:5: stages[0].start.valu: unknown key (did you mean value?)",
        "recipe.yaml:8: stages[1].fit.limit: input should be greater than 0, not -1",
        "recipe.yaml:9: stages[1].fit.mode: must be 'fast' or 'exact', not 'exakt' (did you mean exact?)",
        "recipe.yaml:10: stages[2]: no stage is called 'fti' (did you mean fit?)",
        "recipe.yaml:12: stages[3].judge.metrics.noise.band: input should be a valid number, not 'wide'",
        "recipe.yaml:12: stages[3].judge.metrics.nose: no metric is called 'nose' (did you mean noise?)",
        "recipe.yaml:13: stages[4].fit.steps: input should be a valid integer, not 'many'",
    ]


def test_unknown_method_hides_no_other_mistake(own):
    stages = "  - start\n  - fit:\n      method: robost\n      limit: 0\n      cut: 1.0\n      stps: 4\n      mode: 3\n"
    assert own.mistakes(stages) == [
        "recipe.yaml:7: stages[1].fit.method: no method of fit is called 'robost' (did you mean robust?)",
        "recipe.yaml:8: stages[1].fit.limit: input should be greater than 0, not 0",
        "recipe.yaml:10: stages[1].fit.stps: fit with any method has no option 'stps' (did you mean steps?)",
        "recipe.yaml:11: stages[1].fit.mode: must be 'fast' or 'exact', not 3",
    ]


def test_option_of_another_method(own):
    stages = "  - start\n  - fit: {method: robust, steps: 3, limit: no}\n"
    assert own.mistakes(stages) == [
        "recipe.yaml:6: stages[1].fit.steps: fit with method robust has no option 'steps'; "
        "it has cut, limit, method, mode, sensors",
        "recipe.yaml:6: stages[1].fit.limit: input should be a valid number, not 'no'",
    ]


def test_mistake_of_metrics_hides_no_other(own):
    own.plugin(PLUGIN.replace("metrics: MetricsChoice = None", "metrics: MetricsChoice = None, level: int = 1"))
    found = own.mistakes("  - start\n  - judge: {metrics: 5, level: high}\n")
    assert len(found) == 2
    assert "stages[1].judge.metrics: must be a list of metrics" in found[0]
    assert "stages[1].judge.level: input should be a valid integer" in found[1]


def test_a_list_holds_names_and_such_with_options(own):
    """Each once: of several of one name only the last would be left."""
    recipe = own.recipe("  - start\n  - judge: {metrics: [noise: {band: 2.0}, flagged]}\n")
    assert [*read_plan(recipe).stages[1].described["metrics"]] == ["noise", "flagged"]
    found = own.mistakes("  - start\n  - judge: {metrics: [noise, noise: {band: 2.0}]}\n")
    assert "stages[1].judge.metrics: names noise twice" in found[0]
    assert "each a name or `metric: {options}`" in own.mistakes("  - start\n  - judge: {metrics: [[noise]]}\n")[0]


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("limit: '5'", "a valid number, not '5'"), ("limit: true", "a valid number, not True"),
        ("limit: [1]", "a valid number"), ("limit: {a: 1}", "a valid number"), ("limit: null", "a valid number"),
        ("limit: .nan", "greater than 0"), ("limit: -.inf", "greater than 0"),
        ("sensors: S1", "must be a list, not 'S1'"), ("sensors: [1]", "a valid string"),
        ("mode: yes", "must be 'fast' or 'exact'"), ("mode: [fast]", "must be 'fast' or 'exact'"),
        ("steps: 1.5", "a valid integer"),
        ("steps: 0", "than or equal to 1"), ("method: {robust: {}}", "no method of fit"),
        ("method: [plain]", "no method of fit"), ("7: x", "no option 7"),
        ("null: x", "no option None"), ("true: x", "no option True"),
    ],
)  # fmt: skip
def test_values_of_the_wrong_kind(own, option, words):
    (line,) = own.mistakes(f"  - start\n  - fit:\n      {option}\n")
    assert line.startswith("recipe.yaml:7: stages[1].fit")
    assert words in line


@pytest.mark.parametrize(
    ("stages", "words"),
    [
        ("  - 5\n", "must be a stage's name"), ("  - 5: {}\n", "must be a stage's name"),
        ("  - null\n", "must be a stage's name"), ("  - true: {}\n", "must be a stage's name"),
        ("  - {start: {}, fit: {}}\n", "must be a stage's name"), ("  - [start]\n", "must be a stage's name"),
        ("  - {}\n", "must be a stage's name"), ("  start: {}\n", "needs a list of stages"),
        ("  []\n", "needs a list of stages"), ("  start\n", "needs a list of stages"),
        ("  - start: 5\n", "must be a mapping of options"), ("  - start: [1]\n", "must be a mapping of options"),
        ("  - ''\n", "no stage is called ''"),
    ],
)  # fmt: skip
def test_stages_of_the_wrong_kind(own, stages, words):
    (line,) = own.mistakes(stages)
    assert words in line
    assert line.startswith("recipe.yaml:")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("5", "a recipe is a mapping"), ("[a]", "a recipe is a mapping"), ("~", "a recipe is a mapping"),
        ("title: t", "needs a list of stages"), ("title: [1]\nstages: [load]", "needs a title"),
        ("titel: t\nstages: [load]", "did you mean title?"), ("stages: [load]", "needs a title"),
        ("title: t\nauthors: 5\nstages: [load]", "must be a list of texts"),
        ("title: t\nplugins: {a: b}\nstages: [load]", "must be a list of texts"),
        ("title: t\nplugins: [none.py]\nstages: [load]", "there is no"),
        ("title: t\nplugins: [magtensro]\nstages: [load]", "did you mean magtensor?"),
        ("title: t\nsurvey: 5\nstages: [load]", "must be a mapping"),
        ("title: t\nsurvey: {}\nstages: [load]", "needs `file` or `files`"),
        ("title: t\nsurvey: {file: [a]}\nstages: [load]", "a valid string"),
        ("title: t\nsurvey: {flie: a}\nstages: [load]", "did you mean file or files?"),
        ("title: t\n5: x\nstages: [load]", "unknown key"), ("title: t\nnull: x\nstages: [load]", "unknown key"),
    ],
)  # fmt: skip
def test_tops_of_the_wrong_kind(tmp_path, text, words):
    path = tmp_path / "recipe.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=r"recipe\.yaml") as caught:
        read_plan(path)
    assert words in str(caught.value)


def test_set_changes_a_value_and_its_place_is_told(own):
    stages = "  - start\n  - fit: {limit: 4}\n"
    assert own.plan(stages, "stages.fit.limit=2.5").stages[1].options["limit"] == 2.5
    assert own.plan(stages, "stages.1.fit.limit=2.5").stages[1].options["limit"] == 2.5
    assert own.plan(stages, "stages.start.value=3").stages[0].options["value"] == 3
    assert own.plan(stages, "stages.fit.sensors=[S1, S2]").stages[1].options["sensors"] == ["S1", "S2"]
    assert own.plan(stages, "title=other", "title=third").title == "third"
    found = own.mistakes(stages, "stages.fit.limit=-1", "stages.fit.method=robost", "stages.start.valu=1")
    assert found == [
        "--set stages.start.valu=1: stages[0].start.valu: unknown key (did you mean value?)",
        "--set stages.fit.method=robost: stages[1].fit.method: no method of fit is called 'robost' "
        "(did you mean robust?)",
        "--set stages.fit.limit=-1: stages[1].fit.limit: input should be greater than 0, not -1",
    ]


def test_set_leaves_the_lines_of_the_rest(own):
    stages = "  - start\n  - fit:\n      limit: 4\n      mode: exakt\n"
    (line,) = own.mistakes(stages, "stages.fit.limit=2")
    assert line.startswith("recipe.yaml:8: ")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("stages.fit.limit", "must read PATH=VALUE"), ("=5", "must read PATH=VALUE"), (" =5", "must read PATH=VALUE"),
        ("stages.fti.limit=5", "did you mean fit?"), ("stages.7.x=5", "there is no 7"),
        ("stages.-1.x=5", "there is no -1"), ("stages.².x=5", "there is no ²"), ("title.x=5", "single value"),
        ("stages.fit.limit.x=5", "single value"),
        ("stages..x=5", "there is no "), ("stages.start.value=5=6", "a valid number"),
        ("stages.fit=5", "must be a mapping"), ("stages=5", "needs a list of stages"), ("nonsense=5", "unknown key"),
        ("stages.judge.x=5", "say which: stages.2.judge or stages.3.judge"),
    ],
)  # fmt: skip
def test_set_that_leads_nowhere(own, text, words):
    with pytest.raises(UsageError) as caught:
        own.plan("  - start\n  - fit: {limit: 4}\n  - judge\n  - judge\n", text)
    assert words in str(caught.value)
    assert f"--set {text}" in str(caught.value)


def test_set_reaches_into_a_survey_given_by_its_name_alone(own):
    assert own.plan("  - start\n", "survey.file=other.h5").survey.file == "other.h5"
