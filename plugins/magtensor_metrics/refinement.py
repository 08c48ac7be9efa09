"""What a refinement of the tensor by its invariants leaves open."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from magtensor import metric
from magtensor.qc import Verdict

if TYPE_CHECKING:
    from magtensor.survey.model import Survey


@metric(needs=("calibration/tensor_matrix",))
def refinement(survey: Survey) -> list[Verdict]:
    """How many of the thirty coefficients of H and D no data determine, and what the method says of them."""
    facts = survey["calibration/tensor_matrix"].attrs
    words = json.loads(facts["verdict"])
    return [Verdict("refinement_unidentified", float(facts["nullity"]), "1", "warn", "; ".join(words))]
