"""Options that every method of refine_invariants has."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

Prior = Annotated[
    list[list[float]] | None,
    Field(description="5 x 5 H to start from and to which the gauge is fixed; the identity when not given"),
]
