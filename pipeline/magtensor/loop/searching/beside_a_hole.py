"""Something that happened once, seen beside samples that were taken out: nothing explains them, or they are loud.

What is left of a hump whose top has gone is two slopes, and an event whose shape is not asked for in between follows
them closely. What acts where samples were taken out has to be significant with these in their place as well.
"""

from __future__ import annotations

import numpy as np

from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.fitting.model import State
from magtensor.loop.searching.contribution import happens_once
from magtensor.loop.searching.gates import Candidate

OF_A_HOLE = "with the samples in their place that were taken out it is no more than noise"


def of_a_hole(chosen: Candidate, without: State, whole: State, models: int) -> str:
    """Why an event is one of the edges of a hole; "" where it acts elsewhere above all, or explains what was there.

    Parameters
    ----------
    without, whole: the fits without some samples, against which it was judged, and with them.
    models: that it was found among.
    """
    taken = np.setdiff1d(whole.residual.samples, without.residual.samples)
    if not taken.size or not happens_once(chosen.model):
        return ""
    terms = chosen.model.terms(whole.excitation).at(whole.residual.samples)
    acts = np.sum(terms.series**2, axis=1)
    there = np.isin(whole.residual.samples, taken)
    if acts[there].mean() <= acts.mean():
        return ""
    p = OwnNoise(whole.residual, whole.terms).p_value(terms) * chosen.tried * models
    return "" if p < chosen.alpha else OF_A_HOLE
