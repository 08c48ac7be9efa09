"""What a person decides while looking at a residual, as the text that prompt, recipe and verdict share.

adopt temperature_offset lag_s=118 channel=temperature
reject channel_response
loop
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from magtensor.errors import UsageError, did_you_mean

ACTIONS = ("adopt", "reject", "loop")
WITHOUT = "without"


@dataclass(frozen=True)
class Decision:
    """One decision.

    Attributes:
        action: adopt or reject an error model by hand, or let the loop search.
        error_model: its name; "" for the loop.
        settings: of an adopted model; those left out are searched.
        without: error models that the loop must leave alone, beside those rejected.
    """

    action: str
    error_model: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    without: tuple[str, ...] = ()

    def __str__(self) -> str:
        words = [self.action, *([self.error_model] if self.error_model else [])]
        words += [f"{name}={_written(value)}" for name, value in self.settings.items()]
        return " ".join([*words, *([WITHOUT, *self.without] if self.without else [])])


def decision_of(text: str) -> Decision:
    """The decision that a text stands for.

    Raises:
        UsageError: it stands for none.
    """
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise UsageError(f"{text!r} cannot be read: {error}") from error
    if not words or words[0] not in ACTIONS:
        word = words[0] if words else ""
        raise UsageError(f"{text!r} is no decision{did_you_mean(word, ACTIONS)}; there are {', '.join(ACTIONS)}")
    action, rest = words[0], words[1:]
    if action == "loop":
        if rest and rest[0] != WITHOUT:
            raise UsageError(f"{text!r}: loop takes nothing, or `{WITHOUT} NAME ...`")
        return Decision(action, without=tuple(rest[1:]))
    if not rest or "=" in rest[0]:
        raise UsageError(f"{text!r}: {action} needs the name of an error model")
    settings: dict[str, Any] = {}
    for word in rest[1:]:
        name, equals, value = word.partition("=")
        if action == "reject" or not equals or not name:
            raise UsageError(f"{text!r}: {word} is out of place; {_form(action)}")
        if name in settings:
            raise UsageError(f"{text!r}: {name} is given twice")
        settings[name] = _read(value)
    return Decision(action, rest[0], settings)


def _form(action: str) -> str:
    return "write `adopt NAME [setting=value ...]`" if action == "adopt" else "write `reject NAME`"


def _read(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def _written(value: Any) -> str:
    text = value if isinstance(value, str) and _read(value) == value else json.dumps(value)
    return shlex.quote(text)
