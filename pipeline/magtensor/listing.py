"""What is installed, for people and for programs: every plugin, what it gives, and each option with its meaning."""

from __future__ import annotations

import json
import math
from typing import Any

from magtensor.components import Component
from magtensor.errors import UsageError, did_you_mean
from magtensor.registry import Plugin, Registry


def describe(registry: Registry) -> dict[str, Any]:
    """All of it as plain data; the options of each component as JSON schema."""
    return {
        "plugins": [p.as_dict() | {"gives": [_label(c) for c in registry.by_plugin(p)]} for p in registry.plugins],
        "components": [_described(registry, c) for _, c in sorted(registry.components.items())],
        "problems": registry.problems,
    }


def _described(registry: Registry, component: Component) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "kind": component.kind,
        "name": component.name,
        "summary": component.summary,
        "plugin": registry.origin[(component.kind, component.step, component.name)].origin,
        "options": _finite(_schema(registry, component)),
    }
    if component.kind == "method":
        facts |= {"stage": component.step, "source": component.source}
    if component.kind == "stage":
        if callable(component.declares):
            facts["variables"] = "depend on the options"
        else:
            declares = component.declares
            facts |= {
                "needs": declares.needs,
                "uses": declares.uses,
                "gives": declares.gives,
                "may_give": declares.may_give,
            }
        facts["methods"] = registry.names("method", component.name)
    if component.suffixes:
        facts["suffixes"] = component.suffixes
    return facts


def _schema(registry: Registry, component: Component) -> dict[str, Any]:
    """The options as JSON schema, those that name a method, metrics or error models with what there is to name."""
    schema = component.options.model_json_schema()
    own, required = schema.get("properties", {}), list(schema.get("required", []))
    choices: dict[str, Any] = {}
    for option, kind in component.collections.items():
        names = registry.names(kind)
        default = component.parameters[option].default
        choices[option] = {
            "anyOf": [
                {"type": "array", "items": {"enum": names}},
                {"type": "object", "propertyNames": {"enum": names}},
                {"type": "null"},
            ],
            "default": default if default is None else list(default),
            "description": f"{kind.replace('_', ' ')}s: names, or `name: {{options}}`; null: all that are installed",
        }
    if component.method_option is not None:
        option, default = component.method_option
        choices[option] = {
            "enum": registry.names("method", component.name),
            "description": "its own options stand beside it; `magtensor plugins METHOD` lists them",
        }
        if default is None:
            required.append(option)
        else:
            choices[option]["default"] = default
    every = {**choices, **own}
    schema["properties"] = {name: every[name] for name in component.parameters if name in every}
    return schema | ({"required": required} if required else {})


def _finite(value: Any) -> Any:
    """JSON has no infinity: such a default becomes text."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_finite(v) for v in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _label(component: Component) -> str:
    return f"{component.step}: {component.name}" if component.step else component.name


def show_plugins(registry: Registry) -> None:
    """Print a table of plugins, then one of components."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console()
    table = Table(title="plugins", title_justify="left")
    for column in ("name", "from", "version", "state"):
        table.add_column(column, overflow="fold")
    for plugin in registry.plugins:
        origin = str(plugin.file) if plugin.file else plugin.distribution
        version = plugin.sha256[:12] if plugin.file else plugin.version
        table.add_row(*(escape(cell) for cell in (plugin.name, origin, version, _state(registry, plugin))))
    console.print(table)
    components = Table(title="what they give", title_justify="left")
    for column in ("kind", "name", "what it does"):
        components.add_column(column, overflow="fold")
    for (kind, step, name), component in sorted(registry.components.items()):
        components.add_row(f"{kind} of {step}" if step else kind, name, escape(component.summary))
    console.print(components)


def _state(registry: Registry, plugin: Plugin) -> str:
    return f"broken: {plugin.error}" if plugin.error else f"{len(registry.by_plugin(plugin))} components"


def show_one(registry: Registry, name: str) -> None:
    """Print every component of that name in full.

    Raises:
        UsageError: there is none.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    found = [(key, c) for key, c in sorted(registry.components.items()) if c.name == name]
    if not found:
        names = {n for _, _, n in registry.components}
        raise UsageError(f"no component is called {name!r}{did_you_mean(name, names)}{registry.broken_in_words()}")
    console = Console()
    for (kind, step, _), component in found:
        console.print(f"[bold]{kind} {name}[/bold]" + (f" of {step}" if step else ""))
        console.print(escape((component.function.__doc__ or "").strip()))
        if component.source:
            console.print(f"source: {escape(component.source)}")
        console.print(escape(f"from {registry.origin[(kind, step, name)].origin}"))
        if kind == "stage" and not callable(component.declares):
            for word in ("needs", "uses", "gives", "may_give"):
                if paths := getattr(component.declares, word):
                    console.print(f"{word.replace('_', ' ')}: {', '.join(paths)}")
        if methods := registry.names("method", name) if kind == "stage" else []:
            console.print(f"methods: {', '.join(methods)}")
        table = Table()
        for column in ("option", "type", "default", "meaning"):
            table.add_column(column, overflow="fold")
        schema = _schema(registry, component)
        required = schema.get("required", [])
        for option, facts in schema.get("properties", {}).items():
            default = "required" if option in required else json.dumps(facts.get("default"))
            table.add_row(option, escape(_type(facts)), escape(default), escape(facts.get("description", "")))
        if table.row_count:
            console.print(table)


def _type(facts: dict[str, Any]) -> str:
    if "enum" in facts:
        return " | ".join(str(v) for v in facts["enum"])
    if "anyOf" in facts:
        return " | ".join(_type(f) for f in facts["anyOf"])
    limits = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
    bounds = [f"{sign} {facts[key]:g}" for key, sign in limits.items() if key in facts]
    return " ".join([str(facts.get("const", facts.get("type", "any"))), *bounds])
