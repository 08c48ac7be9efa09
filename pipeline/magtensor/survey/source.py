"""Where a survey comes from: the recipe's section, its folder, and the readers at hand."""

from __future__ import annotations

import glob
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magtensor.components import Component
from magtensor.errors import DataError, UsageError, did_you_mean
from magtensor.survey.hdf5 import read_hdf5
from magtensor.survey.sections import FileSection, SurveySection
from magtensor.survey.tables import Tables, existing

if TYPE_CHECKING:
    from magtensor.survey.model import Survey


@dataclass(frozen=True)
class Source:
    """A survey that can be read.

    Attributes:
        section: the recipe's `survey` section.
        base: what relative file names are relative to.
        readers: reader components by name.
        rows: read only these samples; all when None. The survey must be one HDF5 file in the canonical layout.
        prepared: reads and prepares another survey as the recipe does this one; None outside a run.
    """

    section: SurveySection
    base: Path
    readers: Mapping[str, Component]
    rows: slice | None = None
    prepared: Callable[[Path], Survey] | None = field(default=None, repr=False, compare=False)
    _tables: dict[Any, Tables] = field(default_factory=dict, repr=False, compare=False)

    def sections(self) -> list[tuple[str, FileSection]]:
        """Every part of the section that names files, with its place in it."""
        found: list[tuple[str, FileSection]] = [("", self.section)]
        parts: list[tuple[str, FileSection | None]] = [
            *((f"sensors.{n}", s) for n, s in (self.section.sensors or {}).items()),
            *((f"channels.{n}", c) for n, c in self.section.channels.items()),
            ("reference", self.section.reference),
            ("attitude", self.section.attitude),
        ]
        return found + [(place, part) for place, part in parts if part is not None and part.names]

    def problems(self) -> list[tuple[str, str]]:
        """What is wrong with readers and their options, as (place in the section, message); no file is opened."""
        found = []
        for place, part in self.sections():
            prefix = f"{place}." if place else ""
            if part.reader is None and place == "" and self.section.sensors is None:
                continue
            if part.reader is not None and part.reader not in self.readers:
                near = did_you_mean(part.reader, self.readers) or f"; installed are {', '.join(sorted(self.readers))}"
                found.append((f"{prefix}reader", f"there is no reader {part.reader}{near}"))
                continue
            component = self.readers.get(part.reader) if part.reader else self._by_suffix(part.names[0])
            if component is None:
                known = sorted({s for c in self.readers.values() for s in c.suffixes})
                found.append(
                    (
                        f"{prefix}reader",
                        f"no reader for {Path(part.names[0]).name}; name one (endings known: {', '.join(known)})",
                    )
                )
                continue
            for error in _option_errors(component, part.options):
                found.append((f"{prefix}options{error[0]}", f"{component.name}: {error[1]}"))
        return found

    def files(self) -> list[Path]:
        """Every file the survey is read from, each once.

        Raises:
            DataError: a file is not there, or a pattern fits none.
        """
        own = [f for _, part in self.sections() for f in self.paths(part)]
        return list(dict.fromkeys([*own, *self.further_files()]))

    def further_files(self) -> list[Path]:
        """The further surveys that the section names, each once, this one left out.

        Raises:
            DataError: as in `files`.
        """
        return [file for file, again in self._named_further() if not again]

    def named_again(self) -> list[str]:
        """What to say of files that `with` names although the fit has them already.

        Raises:
            DataError: as in `files`.
        """
        names = dict.fromkeys(file.name for file, again in self._named_further() if again)
        return [f"{name} is named more than once (survey: with) and is used once" for name in names]

    def _named_further(self) -> list[tuple[Path, bool]]:
        """Every file that `with` names, and whether it was named before."""
        names = self.section.with_ or []
        taken = {file.resolve() for file in self.paths(self.section)}
        found = []
        for file in self.paths(FileSection(files=[names] if isinstance(names, str) else names)):
            found.append((file, file.resolve() in taken))
            taken.add(file.resolve())
        return found

    def further_surveys(self) -> list[tuple[str, Survey]]:
        """Name and content of each of them, prepared by the recipe's own stages."""
        files = self.further_files()
        if files and self.prepared is None:
            raise UsageError("further surveys can be read only by a recipe that is run")
        return [(f.name, self.prepared(f)) for f in files if self.prepared is not None]

    def paths(self, part: FileSection) -> list[Path]:
        """The files one part of the section names, patterns resolved, in order.

        Raises:
            DataError: a file is not there or empty, or a pattern fits none.
        """
        found: list[Path] = []
        for name in part.names:
            path = self.base / Path(name).expanduser()
            if glob.has_magic(name) and not path.exists():
                fitting = sorted(Path(p) for p in glob.glob(str(path)))
                if not fitting:
                    raise DataError(f"no file fits the pattern {name}", where=str(path.parent))
                found += fitting
            else:
                found.append(path)
        return existing(found)

    def tables(self, part: FileSection) -> Tables:
        """The columns of the files a part of the section names; read once even if several parts name them.

        Raises:
            UsageError: no such reader, or wrong options.
            DataError: the files cannot be read.
        """
        paths = self.paths(part)
        component = self._reader(part, paths[0])
        key = (tuple(paths), component.name, repr(sorted(part.options.items())))
        if key not in self._tables:
            import json

            options = component.options.model_validate_json(json.dumps(part.options))
            values = {name: getattr(options, name) for name in type(options).model_fields}
            self._tables[key] = component.function(paths, **values)
        return self._tables[key]

    def shape(self) -> tuple[int, int]:
        """Samples and sensors of a survey that can be read in windows.

        Raises:
            UsageError: it cannot.
        """
        if self.section.sensors is not None or self.section.reader is not None or len(self.paths(self.section)) > 1:
            raise UsageError(
                "only a survey in one HDF5 file of the canonical layout can be read in windows; leave --memory away"
            )
        samples, sensors, *_ = read_hdf5(self.paths(self.section)).find("b_raw").shape
        return samples, sensors

    def read(self) -> Survey:
        """Read the survey: the canonical layout, or through the section's mapping.

        Raises:
            UsageError: a reader or its options are wrong.
            DataError: the files are not what the section says.
        """
        from magtensor.survey.canonical import survey_from

        wrong = self.problems()
        if wrong:
            raise UsageError("\n".join(f"survey.{place}: {message}" for place, message in wrong))
        try:
            if self.section.sensors is not None:
                from magtensor.survey.mapping import mapped

                return mapped(self)
            if self.section.reader is None:
                paths = self.paths(self.section)
                if len(paths) > 1:
                    raise DataError(
                        f"{len(paths)} files, but a canonical survey is one file",
                        hint="a mapping with `sensors` can join files that follow each other",
                    )
                tables = read_hdf5(paths)
                survey = survey_from(tables if self.rows is None else tables.window(self.rows))
            else:
                survey = survey_from(self.tables(self.section))
            if self.section.reference is None:
                return survey
            from magtensor.survey.mapping import with_reference

            return with_reference(survey, self)
        finally:
            self._tables.clear()

    def _reader(self, part: FileSection, path: Path) -> Component:
        found = self.readers.get(part.reader) if part.reader else self._by_suffix(path.name)
        if found is None:
            raise UsageError(f"survey: no reader for {path.name}; name one: {', '.join(sorted(self.readers))}")
        return found

    def _by_suffix(self, name: str) -> Component | None:
        fitting = [(len(s), c) for c in self.readers.values() for s in c.suffixes if name.lower().endswith(s.lower())]
        return max(fitting, key=lambda pair: pair[0])[1] if fitting else None


def _option_errors(component: Component, options: Mapping[str, Any]) -> list[tuple[str, str]]:
    import json

    from pydantic import ValidationError

    try:
        component.options.model_validate_json(json.dumps(options))
    except ValidationError as error:
        found = []
        for one in error.errors(include_url=False):
            place = "".join(f".{p}" for p in one["loc"])
            if one["type"] == "extra_forbidden":
                known = list(component.options.model_fields)
                near = did_you_mean(str(one["loc"][-1]), known) or f"; it has {', '.join(known)}"
                found.append((place, f"has no option {one['loc'][-1]}{near}"))
            else:
                found.append((place, str(one["msg"])))
        return found
    return []
