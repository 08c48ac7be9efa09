"""Do surveys agree about the one C that was fitted to them?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .about import about_line
from .fit import SurveysFit
from .samples import Samples
from .straight import SIGNIFICANT


def disagreement_in_words(fit: SurveysFit, samples: Samples, names: Sequence[str]) -> str:
    """What to say where each survey's own C lies off the common one by more than noise explains; else nothing.

    Parameters
    ----------
    samples: that were fitted; names: of the surveys.
    """
    from scipy.special import chdtrc

    if len(names) == 1 or samples.level is not None:
        return ""
    about, variance = about_line(fit.design, fit.said, fit.chi2_along)
    if about is None or chdtrc(about[1], about[0]) >= SIGNIFICANT:
        return ""
    words = (
        f"the surveys disagree about C: chi2 {about[0]:.4g} of each one's own about the common one, where noise has "
        f"{about[1]:.4g}; C scatters by {np.sqrt(variance):.2g} (rms of its elements) between them, which the standard "
        "deviations do not hold"
    )
    left = np.bincount(samples.survey[~fit.keep], minlength=len(names))
    if left.any():
        each = ", ".join(f"{name} {n}" for name, n in zip(names, left, strict=True) if n)
        words += f"; {left.sum()} of {len(samples.survey)} samples were left out as if disturbed ({each})"
    return f"{words}. Where C ages, `matrices: linear` fits its change with the date"
