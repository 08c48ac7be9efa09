"""Whether a candidate only follows a part of one waveform that the sensors share.

Noise of each sensor's own does not make several of them move in step, so that by it the smallest likeness between a
channel and what moves them all is impossible. But one course goes with another by chance, and only their likeness tells
whether it is the channel's.
"""

from __future__ import annotations

import numpy as np

from magtensor.loop.evidence.folds import FOLDS
from magtensor.loop.fitting.model import Record, State
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.latent import sought
from magtensor.loop.searching.likeness import held_out_losses

MOST = 0.5  # of the waveform's square, on stretches that were not fitted
OF_A_WAVEFORM = "it predicts a small part of one waveform that the sensors share, which is no noise of each"


def part_of_a_waveform(chosen: Candidate, state: State, record: Record) -> str:
    """Why a candidate is not believed that noise of each sensor's own does not explain, where the blocks of the survey
    tell little of it; "" where they do, where the sensors share no waveform that a source nobody logged may make, and
    where the candidate predicts most of that."""
    by_blocks = chosen.adjusted_p < chosen.alpha or not chosen.beyond_own_noise
    if by_blocks or chosen.before is not None or chosen.moved is not None:
        return ""
    shared = sought(state, record)
    if shared is None or not shared.significant or shared.objection:
        return ""
    waveform = np.interp(record.time[state.residual.samples], shared.time, shared.values)
    ones, edges = np.ones((len(waveform), 1)), np.linspace(0, len(waveform), FOLDS + 1).round().astype(int)
    columns = np.column_stack([ones, chosen.terms.series])
    left, whole = (float(held_out_losses(waveform, c, edges).sum()) for c in (columns, ones))
    return OF_A_WAVEFORM if left > (1.0 - MOST) * whole else ""
