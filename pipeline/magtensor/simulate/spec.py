"""What every part of a scenario is written in: strict models, vectors, and a named random stream for each part."""

from __future__ import annotations

import zlib
from datetime import UTC, datetime
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from magtensor.errors import UsageError

Array = NDArray[np.float64]

Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Matrix3 = Annotated[list[Vector3], Field(min_length=3, max_length=3)]


def _vectors(value: object) -> object:
    """One message for all that is no vector, nor a list of vectors."""

    def numbers(row: object) -> bool:
        return isinstance(row, list) and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in row)

    if isinstance(value, list) and value:
        rows = [value] if numbers(value) else value
        if all(numbers(row) and len(row) == 3 for row in rows):
            return value
    raise ValueError(
        "needs three numbers (x, y, z): one such list for all sensors, or a list of them with one for each sensor; "
        "a value that a sensor's axes share is written three times"
    )


PerSensor = Annotated[Vector3 | list[Vector3], BeforeValidator(_vectors)]  # one for all sensors, or one per sensor


def _in_utc(value: str) -> str:
    """ISO 8601 with Z, an offset or neither (then it is UTC), to the form with Z."""
    when = datetime.fromisoformat(value)
    zoned = when if when.tzinfo else when.replace(tzinfo=UTC)
    return zoned.astimezone(UTC).isoformat().replace("+00:00", "Z")


UtcTime = Annotated[str, AfterValidator(_in_utc)]


class Spec(BaseModel):
    """Base of all scenario sections: nothing unknown, nothing converted silently, no infinities."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


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
