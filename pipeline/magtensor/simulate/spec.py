"""What every part of a scenario is written in: strict models, vectors, and a named random stream for each part."""

from __future__ import annotations

import zlib
from datetime import UTC, datetime
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from magtensor.errors import UsageError, did_you_mean

Array = NDArray[np.float64]

Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Matrix3 = Annotated[list[Vector3], Field(min_length=3, max_length=3)]
PerSensor = Vector3 | list[Vector3]  # one vector for all sensors, or one per sensor


def _as_utc_text(value: object) -> object:
    """YAML reads an unquoted time as a datetime; text may carry Z, an offset or neither (then it is UTC)."""
    if isinstance(value, str):
        value = datetime.fromisoformat(value)
    if isinstance(value, datetime):
        zoned = value if value.tzinfo else value.replace(tzinfo=UTC)
        return zoned.astimezone(UTC).isoformat().replace("+00:00", "Z")
    return value


UtcTime = Annotated[str, BeforeValidator(_as_utc_text)]


class Spec(BaseModel):
    """Base of all scenario sections: nothing unknown, nothing converted silently, no infinities."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)

    @model_validator(mode="wrap")
    @classmethod
    def _suggest_known_keys(cls, data: Any, handler: Any) -> Any:
        try:
            return handler(data)
        except ValidationError as error:
            raise ValidationError.from_exception_data(
                error.title, [_explained(cls, detail) for detail in error.errors(include_url=False)]
            ) from None


def _explained(model: type[Spec], detail: Any) -> InitErrorDetails:
    loc, kind = detail["loc"], detail["type"]
    if kind == "extra_forbidden" and len(loc) == 1:
        known = sorted(model.model_fields)
        message = f"unknown key{did_you_mean(str(loc[0]), known)}; known here: {', '.join(known)}"
        return InitErrorDetails(
            type=PydanticCustomError("unknown_key", message), loc=loc, input=detail["input"]
        )
    if kind in ("unknown_key", "value_error"):
        message = detail["msg"].removeprefix("Value error, ").replace("{", "(").replace("}", ")")
        return InitErrorDetails(
            type=PydanticCustomError("unknown_key", message), loc=loc, input=detail["input"]
        )
    rebuilt = InitErrorDetails(type=kind, loc=loc, input=detail["input"])
    if "ctx" in detail:
        rebuilt["ctx"] = detail["ctx"]
    return rebuilt


def stream(seed: int, *names: str) -> np.random.Generator:
    """A random generator of its own for each named part, so that adding a part leaves the others' draws alone."""
    return np.random.default_rng([seed, *(zlib.crc32(name.encode()) for name in names)])


def per_sensor(values: PerSensor, sensors: int, what: str) -> Array:
    """(S, 3) from one vector for all sensors or one for each.

    Raises:
        UsageError: the number of vectors is neither one nor the number of sensors.
    """
    rows = np.atleast_2d(np.asarray(values, dtype=float))
    if len(rows) not in (1, sensors):
        raise UsageError(
            f"{what} has {len(rows)} vectors; the array has {sensors} sensors (give one vector, or {sensors})"
        )
    return np.broadcast_to(rows, (sensors, 3)).copy()
