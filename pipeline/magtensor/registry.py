"""Finds plugins, built-in and foreign alike, and knows every component by kind and name."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import pluggy

from magtensor import hookspecs
from magtensor.components import KINDS, Component, PluginError, component_of, own_attribute
from magtensor.errors import UsageError, did_you_mean

ENTRY_POINTS = "magtensor"


@dataclass(frozen=True)
class Plugin:
    """Where components come from.

    Attributes:
        name: the entry point's name, or the file's stem.
        distribution, version: of the installed package; "" for a single file.
        file: the single file; None for a package.
        sha256: of the single file; "" for a package.
        error: why it could not be loaded; "" if it could.
    """

    name: str
    distribution: str = ""
    version: str = ""
    file: Path | None = None
    sha256: str = ""
    error: str = ""

    @property
    def origin(self) -> str:
        """What messages call it: `magtensor 0.1.0 (stages)` or the file."""
        return str(self.file) if self.file else f"{self.distribution} {self.version} ({self.name})"

    def as_dict(self) -> dict[str, str]:
        """For provenance and `plugins --json`."""
        facts = {"name": self.name, "distribution": self.distribution, "version": self.version}
        if self.file:
            facts = {"name": self.name, "file": str(self.file), "sha256": self.sha256}
        return facts | ({"error": self.error} if self.error else {})


@dataclass
class Registry:
    """Every component that the plugins give.

    Attributes:
        plugins: all that were found, broken ones included, in the order found.
        components: by (kind, step, name); `step` is "" but for methods.
        origin: the plugin of each component.
        problems: duplicates and misspelled hooks, each naming the distributions.
    """

    plugins: list[Plugin] = field(default_factory=list)
    components: dict[tuple[str, str, str], Component] = field(default_factory=dict)
    origin: dict[tuple[str, str, str], Plugin] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    @classmethod
    def load(cls, folders: Iterable[Path] = ()) -> Registry:
        """Discover entry points, then the single files of the folders (or files) given, in that order.

        A plugin that fails to import is kept as broken; nothing is raised for it here.

        Raises:
            UsageError: a folder does not exist.
        """
        registry = cls()
        points = importlib.metadata.entry_points(group=ENTRY_POINTS)
        unique = {(p.name, p.value, p.dist.name if p.dist else ""): p for p in points}
        for point in sorted(unique.values(), key=lambda p: (p.dist.name if p.dist else "", p.name)):
            plugin = Plugin(point.name, point.dist.name if point.dist else "", point.dist.version if point.dist else "")
            registry._add(plugin, point.load)
        seen: set[Path] = set()
        for folder in folders:
            for file in _single_files(Path(folder)):
                if file.resolve() not in seen:
                    seen.add(file.resolve())
                    digest = hashlib.sha256(file.read_bytes()).hexdigest()
                    registry._add(
                        Plugin(file.stem, file=file, sha256=digest), lambda f=file, d=digest: _import_file(f, d)
                    )
        return registry

    def _add(self, plugin: Plugin, load: Any) -> None:
        try:
            with contextlib.redirect_stdout(sys.stderr):  # standard output is for answers, not for plugins
                found = list(_components(load(), plugin))
        except PluginError as error:
            self.problems.append(f"{plugin.origin}: {error}")
            self.plugins.append(_broken(plugin, str(error)))
            return
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # also SystemExit: a plugin must not end the program
            self.plugins.append(_broken(plugin, f"{type(error).__name__}: {error}"))
            return
        try:
            for component in found:
                component.check()
        except PluginError as error:
            self.plugins.append(_broken(plugin, str(error)))
            return
        self.plugins.append(plugin)
        for component in found:
            key = (component.kind, component.step, component.name)
            if self.components.get(key) is component:  # a package that shows one function in two places
                continue
            if key in self.components:
                what = f"{component.kind} {component.name}" + (f" of {component.step}" if component.step else "")
                self.problems.append(f"{what} is given twice: by {self.origin[key].origin} and by {plugin.origin}")
                continue
            self.components[key] = component
            self.origin[key] = plugin

    def check(self) -> None:
        """Refuse to work with duplicates and misspelled hooks.

        Raises:
            UsageError: naming the distributions.
        """
        if self.problems:
            raise UsageError("plugins: " + "\n".join(self.problems))

    def names(self, kind: str, step: str = "") -> list[str]:
        """The names of one kind, sorted; of a step's methods with kind "method"."""
        return sorted(n for k, s, n in self.components if k == kind and s == step)

    def find(self, kind: str, name: str, step: str = "") -> Component:
        """The component of that name.

        Raises:
            UsageError: there is none; says what is near, and which plugins could not be loaded.
        """
        found = self.components.get((kind, step, name))
        if found is None:
            raise UsageError(self.unknown(kind, name, step))
        return found

    def unknown(self, kind: str, name: str, step: str = "") -> str:
        """The message for a name that no plugin gives."""
        known = self.names(kind, step)
        of = f" of {step}" if step else ""
        near = did_you_mean(name, known) or f"; there are {', '.join(known) or 'none'}"
        return f"no {kind.replace('_', ' ')}{of} is called {name!r}{near}{self.broken_in_words()}"

    def broken_in_words(self) -> str:
        """For a message about something that is missing: a line for each plugin that could not be loaded."""
        return "".join(f"\n  the plugin {p.origin} could not be loaded: {p.error}" for p in self.broken())

    def broken(self) -> Iterator[Plugin]:
        """The plugins that could not be loaded."""
        return (p for p in self.plugins if p.error)

    def by_plugin(self, plugin: Plugin) -> list[Component]:
        """What one plugin gives."""
        return [c for key, c in self.components.items() if self.origin[key] is plugin]


def _broken(plugin: Plugin, error: str) -> Plugin:
    return Plugin(plugin.name, plugin.distribution, plugin.version, plugin.file, plugin.sha256, error)


def _single_files(folder: Path) -> list[Path]:
    if folder.is_file():
        if folder.suffix != ".py":
            raise UsageError(f"plugin file {folder} is no Python file")
        return [folder]
    if not folder.is_dir():
        raise UsageError(f"plugin folder {folder} does not exist")
    return sorted(f for f in folder.glob("*.py") if not f.name.startswith("_"))


def _import_file(file: Path, digest: str) -> ModuleType:
    name = f"magtensor_file_{file.stem}_{digest[:12]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # before execution: dataclasses and pickle look the module up
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _components(module: ModuleType, plugin: Plugin) -> Iterator[Component]:
    manager = pluggy.PluginManager(hookspecs.PROJECT)
    manager.add_hookspecs(hookspecs)
    specs = {n for n in vars(hookspecs) if n.startswith(f"{hookspecs.PROJECT}_")}
    for name, value in vars(module).items():
        marked = isinstance(own_attribute(value, f"{hookspecs.PROJECT}_impl"), dict)
        hook_like = name.startswith(f"{hookspecs.PROJECT}_") and callable(value) and component_of(value) is None
        if (marked or hook_like) and name not in specs:
            raise PluginError(f"{name} is no hook of magtensor{did_you_mean(name, specs)}")
        if hook_like and not marked:
            raise PluginError(f"{name} lacks @hookimpl (from magtensor.hookspecs import hookimpl)")
    manager.register(module, name=plugin.name)
    given: dict[int, Component] = {}
    for value in vars(module).values():
        component = component_of(value)
        # only its package's own: a plugin may import another's function to build upon it
        if component is not None and _package(component.function.__module__) == _package(module.__name__):
            given[id(component)] = component
    for batch in manager.hook.magtensor_components():
        for value in batch:
            component = component_of(value)
            if component is None:
                raise PluginError(
                    f"magtensor_components gives {value!r}, which is not marked with @{', @'.join(KINDS)}"
                )
            given[id(component)] = component
    yield from given.values()


def _package(module: str) -> str:
    return module.split(".", 1)[0]
