"""Look at a residual, adopt and reject error models by hand, look again, and save what came of it."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from magtensor.accuracy import figure
from magtensor.calibration.nominal import Nominal
from magtensor.closed_loop import STAGE, loop_document
from magtensor.errors import MagtensorError, UsageError
from magtensor.loop.decisions import Decision, decision_of
from magtensor.loop.fitting.model import Fitting
from magtensor.loop.inquiry import Inquiry, inquiry_of
from magtensor.loop.near_nominal import begun
from magtensor.loop.searching.outcome import judgement
from magtensor.loop.searching.unexplained import unexplained
from magtensor.preparing import empty_survey
from magtensor.recipe.plan import Plan, plan
from magtensor.recipe.source import Document
from magtensor.runner import RunResult, run_stage
from magtensor.session import Computed, Finished, judged, require_verifying
from magtensor.survey.in_memory import Held, SurveyLike, given_survey

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


def explore(
    survey: SurveyLike,
    *,
    verify: SurveyLike | None = None,
    plugins: Sequence[str | Path] = (),
    **options: Any,
) -> Explorer:
    """Open a survey for a search by hand; surveys and options as in `magtensor.close_loop`.

    Raises:
        UsageError: an option is wrong.
        DataError, NotEnoughData: the survey is wrong, or not enough to calibrate.
    """
    return Explorer(loop_document(options), given_survey(survey), verify=verify, plugins=plugins)


class Explorer:
    """A survey, its calibration as far as it has come, and what remains.

    Nothing is changed by a method that raises. Every decision (`adopt`, `reject`, `run_loop`) can be undone.

    Args:
        document: a recipe with the stage `close_loop`; decisions that it holds are taken first.
        given: the survey; the recipe's own if None.
        verify: a second survey in a uniform field, for the verdict; the recipe's own if None.
        plugins: folders of single-file plugins, or such files.
    """

    def __init__(
        self,
        document: Document,
        given: Path | Held | None,
        *,
        verify: SurveyLike | None = None,
        plugins: Sequence[str | Path] = (),
    ) -> None:
        self._document, self._given = document, given
        self._folders = [Path(p) for p in plugins]
        self._verify = None if verify is None else given_survey(verify)
        self._planned = self._plan(self._folders, None)
        self._place = next((i for i, s in enumerate(self._planned.stages) if s.name == STAGE), -1)
        if self._place < 0:
            raise UsageError(f"{document.file}: the recipe has no stage {STAGE}, there is nothing to explore")
        self._verify = self._verify or self._planned.verify
        if self._verify is not None:
            require_verifying(self._planned, self._verify, self.sources)
        survey = empty_survey(given if isinstance(given, Held) else self._planned)
        records = []
        for stage in self._planned.stages[: self._place]:
            survey, record = run_stage(stage, survey)
            records.append(record)
        self._prepared, self._records = survey, tuple(records)
        self._inquiry = self._inquired(self._planned)
        for text in self._planned.stages[self._place].described.get("decisions", ()):
            self._inquiry.decide(decision_of(text))

    def ranking(self) -> pd.DataFrame:
        """The most promising error models that are open, each with its best settings, by held-out gain.

        Columns: settings; p after correction for all that was tried; held_out_gain (twice the log likelihood) and its
        paired t over ten folds; passes, whether the loop's first two gates let it pass; judgement, in words.
        """
        import pandas as pd

        columns = ["error_model", "settings", "p", "held_out_gain", "t", "passes", "judgement"]
        rows = [{**judgement(c), "judgement": judgement(c)["why"]} for c in self._inquiry.ranking()]
        return pd.DataFrame(rows, columns=columns).set_index("error_model")

    @property
    def not_tested(self) -> dict[str, list[str]]:
        """Error models that this survey cannot have, and what it lacks for each."""
        return {m.name: lacks for m in self._inquiry.models if (lacks := self._inquiry.lacks(m))}

    @property
    def residual(self) -> xr.Dataset:
        """What is left: `total_field` (time, sensor) |b| - F nT and `contrast` (time, sensor, axis), each sensor less
        the mean of all, nT; `noise` (sensor, axis) nT of the outputs, found from the data."""
        import numpy as np
        import xarray as xr

        record, b = self._inquiry.left()
        assert record.total_field is not None
        noise = self._inquiry.now.state.residual.noise.reshape(-1, 3)
        units = {"units": "nT"}
        return xr.Dataset(
            {
                "total_field": (
                    ("time", "sensor"),
                    np.linalg.norm(b, axis=2) - record.total_field[:, None],
                    {**units, "long_name": "|b| - total field"},
                ),
                "contrast": (
                    ("time", "sensor", "axis"),
                    b - b.mean(axis=1, keepdims=True),
                    {**units, "long_name": "sensor less the mean of all sensors"},
                ),
                "noise": (("sensor", "axis"), noise, {**units, "long_name": "white noise of the outputs"}),
            },
            coords={
                "time": ("time", record.time, dict(self._prepared["time"].attrs)),
                "sensor": list(record.sensors),
                "axis": ["x", "y", "z"],
            },
        )

    def left_over(self) -> dict[str, Any]:
        """The verdict's block `unexplained` as it would be now: whether what is left is noise, else what it is like."""
        found = self._inquiry.found()
        return unexplained(found, found.record)

    @property
    def adopted(self) -> list[str]:
        """What is in the model beside `linear`, with settings, sensors and who put it there."""
        now = self._inquiry.now
        return [
            f"{a.name} {' '.join(f'{k}={_short(v)}' for k, v in a.settings.items())} ({by})"
            for a, by in zip(now.state.adopted, now.by, strict=True)
        ]

    @property
    def decisions(self) -> list[tuple[str, str]]:
        """Decisions so far, each with what the loop computed of it."""
        return [(str(decision), told) for decision, told in self._inquiry.now.made]

    def adopt(self, name: str, **settings: Any) -> str:
        """Put an error model into the calibration, whatever the loop says of it, and refit everything.

        Args:
            name: of the error model.
            settings: that are to be held; the others are searched.

        Returns:
            What the loop says of it.

        Raises:
            UsageError: there is no such model or setting, or it is there already.
            DataError: the survey lacks what the model needs, or nothing can be calibrated with it.
        """
        return self._inquiry.adopt(name, settings)

    def reject(self, name: str) -> str:
        """Take an error model out again, or off the ranking; the loop leaves it alone from now on.

        Returns:
            What the loop says of it.

        Raises:
            UsageError: there is no such model.
        """
        return self._inquiry.reject(name)

    def run_loop(self) -> str:
        """Let the loop search on, with all that is adopted kept and what was rejected left alone.

        Returns:
            What it adopted.
        """
        return self._inquiry.loop()

    def decide(self, text: str) -> str:
        """A decision as text: `adopt NAME setting=value`, `reject NAME`, `loop`; as those methods."""
        return self._inquiry.decide(decision_of(text))

    def undo(self) -> str:
        """Take the last decision back.

        Returns:
            The decision.

        Raises:
            UsageError: there is none.
        """
        return str(self._inquiry.undo())

    def load_plugin(self, path: str | Path) -> list[str]:
        """Take the error models of a plugin file, or of a folder of them, into the ranking.

        A file that was changed since it was loaded takes the place of what it was, and all decisions are made again
        with it.

        Returns:
            The names of the error models that are new or changed.

        Raises:
            UsageError: it cannot be loaded, or gives no error model, or one that there is already.
            DataError: a decision cannot be made again with it.
        """
        path = Path(path)
        folders = [*self._folders, *([path] if path.resolve() not in {f.resolve() for f in self._folders} else [])]
        planned = self._plan(folders, None)
        broken = [p for p in planned.registry.broken() if p.file is not None and _lies_in(p.file, path)]
        if broken:
            raise UsageError(f"{broken[0].file} cannot be loaded: {broken[0].error}")
        before = {m.name: m.function for m in self._inquiry.models}
        inquiry = self._inquired(planned)
        given = [m for m in inquiry.models if before.get(m.name) is not m.function]
        for model in given:
            if not inquiry.lacks(model):
                _try(model, self._inquiry)
        if not given and not any(
            c.kind == "error_model" and (file := planned.registry.origin[key].file) and _lies_in(file, path)
            for key, c in planned.registry.components.items()
        ):
            raise UsageError(f"{path} gives no error model: mark a function with @error_model")
        if any(m.name in before for m in given):
            for decision, _ in self._inquiry.now.made:
                inquiry.decide(decision)
            self._inquiry = inquiry
        else:
            self._inquiry.add_models(given)
        self._planned, self._folders = planned, folders
        return [m.name for m in given]

    def compute(self) -> Computed:
        """The rest of the recipe, with the calibration as it stands."""
        planned = self._plan(self._folders, [d for d, _ in self._inquiry.now.made])
        survey, records = self._prepared, list(self._records)
        for number, stage in enumerate(planned.stages[self._place :]):
            function = stage.component.function
            used = self._used(function) if number == 0 else None
            survey, record = run_stage(stage, survey, used)
            records.append(record)
        return judged(planned, RunResult(survey, tuple(records)), self._verify)

    def save(self, directory: str | Path) -> Finished:
        """Write result.nc, calibration.nc, verdict.json and report.html into a folder, all or none.

        The verdict says who adopted and rejected what, and what the loop computed of it. The result can be run again:
        its recipe holds the decisions.
        """
        return self.compute().write(Path(directory))

    def verdict(self) -> dict[str, Any]:
        """The content that `verdict.json` would have now."""
        return self.compute().outcome

    def recipe(self) -> str:
        """The recipe, with all decisions, as YAML."""
        planned = self._plan(self._folders, [d for d, _ in self._inquiry.now.made])
        return yaml.safe_dump(planned.resolved(), sort_keys=False, allow_unicode=True, width=110)

    def summary(self) -> str:
        """Where it stands, in a few lines."""
        left = self.residual
        along = left["total_field"].std("time").values
        rms = ", ".join(f"{s} {figure(float(v))}" for s, v in zip(left["sensor"].values, along, strict=True))
        noise = float((left["noise"] ** 2).mean() ** 0.5)
        lines = [f"model: linear{''.join(f', {a}' for a in self.adopted)}"]
        lines.append(f"|b| - F: {rms} nT rms; noise of an output {figure(noise)} nT")
        if rejected := self._inquiry.now.rejected:
            lines.append(f"rejected by hand: {', '.join(rejected)}")
        lines.append(f"{len(self.decisions)} decision{'s' * (len(self.decisions) != 1)}")
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"<Explorer>\n{self.summary()}"

    @property
    def registry(self) -> Any:
        """Every plugin that is loaded."""
        return self._planned.registry

    @property
    def sources(self) -> list[Path]:
        """The files that the survey is read from."""
        return [] if isinstance(self._given, Held) else self._planned.source().files()

    @property
    def inputs(self) -> list[Path]:
        """These, and the file of the verification survey."""
        return [*self.sources, *([self._verify] if isinstance(self._verify, Path) else [])]

    def _plan(self, folders: Sequence[Path], decisions: Sequence[Decision] | None) -> Plan:
        document = self._document
        if decisions is not None:
            named = [m.name for m in self._inquiry.models]
            document = with_decisions(document, [str(d) for d in decisions], named)
        survey, verify = (None if isinstance(one, Held) else one for one in (self._given, self._verify))
        return plan(document, plugin_folders=folders, survey=survey, verify=verify)

    def _inquired(self, planned: Plan) -> Inquiry:
        options: Mapping[str, Any] = planned.stages[self._place].options
        models = {n: c for n, (c, _) in dict(options["search"] or {}).items()}
        for path, component in planned.registry.components.items():  # what a person names, he means
            file = planned.registry.origin[path].file
            if component.kind == "error_model" and file is not None:
                models.setdefault(component.name, component)

        def inquired(how: Fitting) -> Inquiry:
            return inquiry_of(
                self._prepared, dict(options["declared"] or {}), models.values(), how,
                most_effects=options["most_effects"], alpha=options["false_alarm"],
            )  # fmt: skip

        near = Nominal(options["nominal_scale"], options["nominal_angle_deg"], options["nominal_offset"])
        nominal = near if options["undetermined"] == "nominal" else None
        return begun(inquired, Fitting(options["reference_noise_nT"], options["worst_error"]), nominal)

    def _used(self, function: Any) -> Any:
        inquiry = self._inquiry
        return lambda view, **options: function(view, inquiry, **options)


def with_decisions(document: Document, decisions: Sequence[str], models: Sequence[str]) -> Document:
    """A recipe whose stage `close_loop` takes these decisions and, where it says what to search, knows these models."""
    value = copy.deepcopy(document.value)
    for place, item in enumerate(value["stages"]):
        if item == STAGE or (isinstance(item, dict) and STAGE in item):
            options = dict((item[STAGE] if isinstance(item, dict) else None) or {})
            if (search := options.get("search")) is not None:
                given = search if isinstance(search, dict) else {key: {} for key in search}
                options["search"] = {**{name: {} for name in models}, **given}
            value["stages"][place] = {STAGE: {**options, "decisions": list(decisions)}}
    return replace(document, value=value)


def _try(model: Any, inquiry: Inquiry) -> None:
    """See that a model makes regressors here: one that does not would spoil the ranking of all."""
    from magtensor.loop.searching.profiling import settings_grid

    x = inquiry.first.excitation
    try:
        for settings in settings_grid(model, x)[:1]:
            model.function(x, **settings)
    except MagtensorError:
        raise
    except Exception as error:
        raise UsageError(f"{model.name} fails on this survey: {type(error).__name__}: {error}") from error


def _lies_in(file: Path, path: Path) -> bool:
    return file.resolve().is_relative_to(path.resolve())


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
