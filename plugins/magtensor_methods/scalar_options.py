"""Options that every scalar method has."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

WorstError = Annotated[
    float,
    Field(
        gt=0,
        le=1,
        description="largest predicted error of |b| accepted, in the worst direction of the whole "
        "sphere, as a fraction of the total field; beyond it the attitudes are refused as not enough",
    ),
]
