"""The one hook of magtensor.

A plugin is a module: named by an entry point of the group `magtensor`, or a single file in a folder that the
recipe or the command line names. Every function in its namespace that is marked with @stage, @method, @reader
or @metric is found by itself; a plugin that makes its components at run time gives them through the hook:

    from magtensor.hookspecs import hookimpl

    @hookimpl
    def magtensor_components():
        return [make_stage(n) for n in (1, 2)]
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import pluggy

PROJECT = "magtensor"
hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def magtensor_components() -> Iterable[Callable[..., Any]]:  # type: ignore[empty-body]
    """Return functions marked with @stage, @method, @reader or @metric."""
