"""From a recipe to a plan: every option checked, every variable accounted for, before any data are read."""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from magtensor.components import Component, Declares
from magtensor.errors import UsageError, did_you_mean
from magtensor.recipe.overrides import item_name, override
from magtensor.recipe.problems import Problems
from magtensor.recipe.source import Document, Location, load_yaml
from magtensor.registry import Registry
from magtensor.survey.sections import SurveySection
from magtensor.survey.source import Source

SEVERAL = {  # why a name is given once, and what would be right
    "error_model": "are found by the search, or adopted by `decisions` of close_loop",
    "metric": "would be the same figure twice",
}
TOP_KEYS = ("title", "description", "authors", "references", "survey", "verify", "plugins", "stages")


@dataclass(frozen=True)
class PlannedStage:
    """A stage with its options bound.

    Attributes:
        component: the stage.
        options: what its function is called with; methods and metrics as callables.
        described: the same as plain data with every default written out, for provenance.
        declares: the variables it touches with these options.
        uses: every component that takes part (the stage, its method, its metrics).
    """

    component: Component
    options: Mapping[str, Any]
    described: Mapping[str, Any]
    declares: Declares
    uses: tuple[Component, ...]

    @property
    def name(self) -> str:
        return self.component.name


@dataclass(frozen=True)
class Plan:
    """A recipe that can run.

    Attributes:
        title, description, authors, references: as the recipe says.
        survey: the survey section; None where the command line must name the survey.
        stages: in the recipe's order.
        registry: the plugins it was made with.
        folder: what relative paths are relative to.
        file: the recipe's file, for messages.
        plugins: folders, files and installed plugins that it cannot do without.
        verify: a second survey in a uniform field, which the fit does not see; its error goes into the verdict.
    """

    title: str
    description: str
    authors: tuple[str, ...]
    references: tuple[str, ...]
    survey: SurveySection | None
    stages: tuple[PlannedStage, ...]
    registry: Registry
    folder: Path
    file: str
    plugins: tuple[str, ...] = ()
    verify: Path | None = None

    def source(self) -> Source:
        """Where the survey comes from.

        Raises:
            UsageError: neither the recipe nor the command line names a survey.
        """
        if self.survey is None:
            raise UsageError(f"{self.file}: names no survey; name one with --input")
        return Source(self.survey, self.folder, readers(self.registry))

    def survey_for(self, path: Path) -> SurveySection:
        """The survey section with its files replaced by one other file."""
        if self.survey is None:
            return SurveySection(file=str(Path(path).resolve()))
        return self.survey.model_copy(update={"file": str(Path(path).resolve()), "files": None, "with_": None})

    def resolved(self) -> dict[str, Any]:
        """The recipe with every default written out; a plan made from it is this plan."""
        found: dict[str, Any] = {
            "title": self.title,
            "description": self.description,
            "authors": list(self.authors),
            "references": list(self.references),
        }
        if self.survey is not None:
            found["survey"] = self.survey.model_dump(mode="json", exclude_none=True, by_alias=True)
        if self.verify is not None:
            found["verify"] = str(self.verify)
        if self.plugins:
            found["plugins"] = list(self.plugins)
        found["stages"] = [{s.name: dict(s.described)} for s in self.stages]
        return found


def read_plan(
    recipe: str | Path,
    *,
    overrides: Sequence[str] = (),
    plugin_folders: Sequence[Path] = (),
    survey: Path | None = None,
    verify: Path | None = None,
) -> Plan:
    """Read a recipe file and plan it.

    Args:
        recipe: the YAML file.
        overrides: `PATH=VALUE` texts, e.g. `stages.align.to=S2` (see `override`).
        plugin_folders: folders of single-file plugins beside those the recipe names.
        survey: takes the place of the files of the recipe's survey section.
        verify: takes the place of the recipe's own verification survey.

    Raises:
        UsageError: every mistake, with file and line.
    """
    return plan(load_yaml(recipe), overrides=overrides, plugin_folders=plugin_folders, survey=survey, verify=verify)


def plan(
    document: Document,
    *,
    overrides: Sequence[str] = (),
    plugin_folders: Sequence[Path] = (),
    survey: Path | None = None,
    verify: Path | None = None,
) -> Plan:
    """Plan a recipe that has been read; as `read_plan`."""
    for text in overrides:
        document = override(document, text)
    return _Planner(document, plugin_folders, survey, verify).plan()


class _Planner:
    def __init__(
        self, document: Document, plugin_folders: Sequence[Path], survey: Path | None, verify: Path | None
    ) -> None:
        self.document = document
        self.problems = Problems(document)
        self.plugin_folders = plugin_folders
        self.input, self.verify = survey, verify
        self.registry = Registry()
        self.several = False

    def plan(self) -> Plan:
        value = self.document.value
        if not isinstance(value, dict):
            raise UsageError(f"{self.document.where(())}: a recipe is a mapping with the keys {', '.join(TOP_KEYS)}")
        for key in value:
            if key not in TOP_KEYS:
                near = did_you_mean(str(key), TOP_KEYS) or f"; a recipe has {', '.join(TOP_KEYS)}"
                self.problems.add((key,), f"unknown key{near}")
        title = self.text("title", required=True)
        description = self.text("description")
        authors, references = self.texts("authors"), self.texts("references")
        plugins = self.plugins()
        survey, verify = self.survey_section(), self.verification()
        self.several = survey is not None and bool(survey.with_)
        stages = self.stages()
        self.check_flow(stages)
        able = sorted(c.name for c in self.registry.components.values() if c.several)
        # by name: a stage whose options are refused is not planned, but it is there
        if self.several and not {item_name(item) for item in value.get("stages") or []} & set(able):
            what = f"no stage here fits several surveys together; {', '.join(able)} does"
            self.problems.add(("survey", "with"), what)
        self.problems.raise_if_any()
        return Plan(
            title, description, authors, references, survey, tuple(stages.values()), self.registry,
            self.document.folder, self.document.file, plugins, verify,
        )  # fmt: skip

    def text(self, key: str, *, required: bool = False) -> str:
        value = self.document.value.get(key)
        if value in (None, "") and not required:
            return ""
        if not isinstance(value, str) or not value.strip():
            self.problems.add((key,) if key in self.document.value else (), f"needs a {key}, a line of text")
            return ""
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        value = self.document.value.get(key) or []
        if isinstance(value, str):
            value = [value]
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            self.problems.add((key,), "must be a list of texts")
            return ()
        return tuple(value)

    def plugins(self) -> tuple[str, ...]:
        """Load the plugins; the recipe's list names folders, files or installed plugins it cannot do without."""
        names = self.texts("plugins")
        folders: list[Path] = [Path(f) for f in self.plugin_folders]
        required: list[tuple[Location, Path | str]] = []
        for i, name in enumerate(names):
            path = self.document.folder / name
            at: Location = ("plugins", i) if isinstance(self.document.value["plugins"], list) else ("plugins",)
            if path.exists():
                folders.append(path)
                required.append((at, path))
            elif "/" in name or name.endswith(".py"):
                self.problems.add(at, f"there is no {path}")
            else:
                required.append((at, name))
        self.registry = Registry.load(folders)
        for message in self.registry.problems:
            self.problems.add((), f"plugins: {message}")
        required += [((), Path(file)) for file in self.plugin_folders if Path(file).is_file()]
        for at, wanted in required:
            self.require(at, wanted)
        named = {wanted for _, wanted in required}
        for plugin in self.registry.broken():  # it may have nothing to do with this recipe
            if not named & {plugin.file or plugin.name, plugin.distribution}:
                told = plugin.file or f"the plugin {plugin.origin}"
                logging.getLogger(__name__).warning("%s could not be loaded: %s", told, plugin.error)
        resolved = [
            str((self.document.folder / n).resolve()) if (self.document.folder / n).exists() else n for n in names
        ]
        return tuple(dict.fromkeys([*resolved, *(str(Path(f).resolve()) for f in self.plugin_folders)]))

    def require(self, at: Location, wanted: Path | str) -> None:
        if isinstance(wanted, Path):
            for plugin in self.registry.broken():
                if plugin.file is not None and plugin.file == wanted:
                    self.problems.add(at, f"{wanted} could not be loaded: {plugin.error}")
            return
        known = {p.name: p for p in self.registry.plugins} | {
            p.distribution: p for p in self.registry.plugins if p.distribution
        }
        if wanted not in known:
            self.problems.add(at, f"no plugin {wanted!r} is installed{did_you_mean(wanted, known)}")
        elif known[wanted].error:
            self.problems.add(at, f"the plugin {wanted} could not be loaded: {known[wanted].error}")

    def survey_section(self) -> SurveySection | None:
        value = self.document.value.get("survey")
        if isinstance(value, str):
            value = {"file": value}
        if self.input is not None:
            value = (
                {k: v for k, v in (value or {}).items() if k not in ("file", "files")}
                | {"file": str(Path(self.input).resolve())}
                if isinstance(value, dict) or value is None
                else value
            )
        if value is None:
            return None
        section = self.problems.validated(SurveySection, value, ("survey",))
        if section is not None:
            for place, message in Source(section, self.document.folder, readers(self.registry)).problems():
                self.problems.add(("survey", *place.split(".")), message)
        return section

    def verification(self) -> Path | None:
        """The verification survey's file."""
        value = self.document.value.get("verify")
        if self.verify is not None or value is None:
            return None if self.verify is None else Path(self.verify).resolve()
        if not isinstance(value, str) or not value:
            self.problems.add(("verify",), "must be one file, a second survey in a uniform field")
            return None
        return (self.document.folder / Path(value).expanduser()).resolve()

    def stages(self) -> dict[int, PlannedStage]:
        items = self.document.value.get("stages")
        if not isinstance(items, list) or not items:
            self.problems.add(("stages",), "needs a list of stages, each a name or `name: {options}`")
            return {}
        planned: dict[int, PlannedStage] = {}
        for i, item in enumerate(items):
            name = item_name(item)
            if name is None:
                self.problems.add(("stages", i), "must be a stage's name, or one `name: {options}`")
                continue
            options = item[name] if isinstance(item, dict) else {}
            at: Location = ("stages", i, name) if isinstance(item, dict) else ("stages", i)
            if ("stage", "", name) not in self.registry.components:
                self.problems.add(at, self.registry.unknown("stage", name))
                continue
            stage = self.stage(self.registry.find("stage", name), {} if options is None else options, at)
            if stage is not None:
                planned[i] = stage
        return planned

    def stage(self, component: Component, options: Any, at: Location) -> PlannedStage | None:
        if not isinstance(options, dict):
            self.problems.add(at, "must be a mapping of options")
            return None
        taken: list[Component] = [component]
        bound: dict[str, Any] = {}
        described: dict[str, Any] = {}
        rest = dict(options)
        whole = True  # one mistake must not hide the others: go on to the end, then give up
        for option, kind in component.collections.items():
            default = component.parameters[option].default
            found = self.collection(kind, option, rest.pop(option, default), at)
            if found is None:
                whole = False
            else:
                bound[option], described[option], used = found
                taken += used
        if component.method_option is not None:
            option, default = component.method_option
            own = set(component.options.model_fields)
            method = self.method(component, rest.pop(option, default), at)
            if method is None:
                whole = False
                of_stage = [c for (_, step, _), c in self.registry.components.items() if step == component.name]
                theirs = {name for c in of_stage for name in c.options.model_fields}
                what = f"{component.name} with any method"
            else:
                theirs = set(method.options.model_fields)
                what = f"{component.name} with method {method.name}"
            known = sorted(own | theirs | {option})
            for key in [k for k in rest if k not in known]:
                near = did_you_mean(str(key), known) or f"; it has {', '.join(known)}"
                self.problems.add((*at, key), f"{what} has no option {key!r}{near}")
                whole = False
            if method is not None:
                model = self.problems.validated(method.options, {k: v for k, v in rest.items() if k in theirs}, at)
                if model is None:
                    whole = False
                else:
                    bound[option] = functools.partial(method.function, **_values(model))
                    bound[option].__name__ = method.name
                    described |= {option: method.name} | model.model_dump(mode="json")
                    taken.append(method)
            rest = {k: v for k, v in rest.items() if k in own}
        model = self.problems.validated(component.options, rest, at)
        if model is None or not whole:
            return None
        described |= model.model_dump(mode="json")
        try:
            declares = component.declared(described, several=self.several)
        except UsageError as error:  # options that contradict each other
            self.problems.add(at, str(error).removeprefix(f"{component.name}: "))
            return None
        return PlannedStage(component, bound | _values(model), described, declares, tuple(taken))

    def method(self, stage: Component, name: Any, at: Location) -> Component | None:
        """The method of a stage that the recipe names; None, with the mistake collected, if there is none."""
        assert stage.method_option is not None
        option, _ = stage.method_option
        if name is None:
            names = ", ".join(self.registry.names("method", stage.name))
            self.problems.add(at, f"needs {option!r}: one of {names or 'none that is installed'}")
            return None
        if ("method", stage.name, str(name)) not in self.registry.components:
            self.problems.add((*at, option), self.registry.unknown("method", str(name), stage.name))
            return None
        return self.registry.find("method", str(name), stage.name)

    def collection(
        self, kind: str, option: str, wanted: Any, at: Location
    ) -> tuple[dict[str, Any], dict[str, Any], list[Component]] | None:
        """A mapping `name: {options}`, or a list of names and of such, or nothing for every metric or error model there
        is."""
        word = kind.replace("_", " ")
        if wanted is None:
            wanted = self.registry.names(kind)
        if isinstance(wanted, (list, tuple)) and all(isinstance(w, str) or _is_one(w) for w in wanted):
            each = [w if isinstance(w, dict) else {w: {}} for w in wanted]
            names = [str(name) for one in each for name in one]
            if twice := sorted({name for name in names if names.count(name) > 1}):
                self.problems.add(
                    (*at, option), f"names {', '.join(twice)} twice; several of one {word} {SEVERAL[kind]}"
                )
                return None
            wanted = {name: options for one in each for name, options in one.items()}
        if not isinstance(wanted, dict):
            self.problems.add((*at, option), f"must be a list of {word}s, each a name or `{word}: {{options}}`")
            return None
        bound: dict[str, Any] = {}
        described: dict[str, Any] = {}
        used = []
        for name, options in wanted.items():
            place = (*at, option, name)
            if (kind, "", str(name)) not in self.registry.components:
                self.problems.add(place, self.registry.unknown(kind, str(name)))
                continue
            one = self.registry.find(kind, name)
            model = self.problems.validated(one.options, {} if options is None else options, place)
            if model is None:
                continue
            used.append(one)
            if kind == "error_model":  # what the recipe leaves open is searched, not set to its default
                given = {k: v for k, v in _values(model).items() if k in (options or {})}
                bound[name], described[name] = (one, given), {k: options[k] for k in given}
            else:
                bound[name] = functools.partial(one.function, **_values(model))
                described[name] = model.model_dump(mode="json")
        return bound, described, used

    def check_flow(self, stages: Mapping[int, PlannedStage]) -> None:
        """Refuse a recipe in which a stage needs a variable that no earlier stage can give."""
        if self.problems.found:
            return  # a stage that could not be planned would make the others look wrong
        available: list[str] = []
        for i, stage in stages.items():
            for need in stage.declares.needs:
                if not any(fnmatchcase(need, a) or fnmatchcase(a, need) for a in available):
                    self.problems.add(
                        ("stages", i), f"{stage.name} needs {need}, which no stage before it gives{self.givers(need)}"
                    )
            available += [*stage.declares.gives, *stage.declares.may_give]

    def givers(self, need: str) -> str:
        found = set()
        for (kind, _, name), component in self.registry.components.items():
            if kind == "stage" and not callable(component.declares):
                patterns = (*component.declares.gives, *component.declares.may_give)
                if any(fnmatchcase(need, g) or fnmatchcase(g, need) for g in patterns):
                    found.add(name)
        return f"; given by {', '.join(sorted(found))}" if found else ""


def readers(registry: Registry) -> dict[str, Component]:
    """The reader components by name."""
    return {name: registry.find("reader", name) for name in registry.names("reader")}


def _is_one(value: Any) -> bool:
    """Whether it is a mapping `name: {options}`."""
    return isinstance(value, dict) and len(value) == 1


def _values(model: Any) -> dict[str, Any]:
    return {name: getattr(model, name) for name in type(model).model_fields}
