"""Noise of any colour in the covariance of what one survey says.

As for a fit of one survey (`magtensor.calibration.score_colour`): the scores of some 128 blocks of neighbouring samples
tell the long-run variance of each group of parameters. Blocks are of one survey, whose own best parameters are taken
off first, so that neither a C of its own nor the years between surveys pass for noise; surveys are independent of each
other, and their scores add up. A total field that is an unknown constant is eliminated from the scores along the field.
Known directions stay as they are: an attitude that drifts has its own measure (`directions.disagreement`).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from magtensor.calibration.blocks import BLOCKS, LEAST_PER_BLOCK, BlockScores
from magtensor.calibration.maximum_likelihood import PAIRS, WEIGHTS, along, scores_of_blocks
from magtensor.calibration.score_colour import FALSE_ALARM, colour_of_scores, whitening
from magtensor.calibration.types import Array

from .said import Said, View, field_change
from .sums import SYMMETRIC

_LAST_FIRST = np.eye(4)[:, [3, 0, 1, 2]]  # from (1, field) to (field, 1)


def with_colour(seen: View, one: Said, surveys: int) -> Said:
    """What a survey says, with the covariance of its scores where its noise does not pass for white.

    Parameters
    ----------
    surveys: among how many a false alarm is to be as rare as in one.
    """
    samples, outputs = seen.residual.shape
    blocks = _block_scores(seen, one.sums.total_field)
    levels = 1 if seen.data.level is None else len(np.unique(seen.data.level))
    freedom = (max(outputs - 3, 0) * (samples - 4), samples - 8 - levels)
    chi2 = (one.across / freedom[0] if freedom[0] > 0 else float("nan"), one.sums.along / max(freedom[1], 1))
    colour = colour_of_scores(blocks, *chi2, false_alarm=FALSE_ALARM / surveys)
    if colour is None:
        return one
    moments = _LAST_FIRST @ blocks.across_normal.sum(axis=0) @ _LAST_FIRST.T
    white = whitening(moments, blocks.along_normal.sum(axis=0))
    outside = np.kron(_complement(seen.basis), _LAST_FIRST @ white.across_root)
    inside = (
        field_change(seen.matrix @ seen.basis.T, SYMMETRIC).T @ np.linalg.inv(white.along_turn).T @ white.along_root
    )
    root = np.concatenate([outside, inside], axis=1)
    if seen.data.level is not None:
        root[:, outside.shape[1]] = 0.0  # the scale, of which only the mean that is held tells
    return replace(one, coloured=root @ colour.covariance @ root.T)


def _block_scores(seen: View, total_field: Array) -> BlockScores:
    """The scores of contiguous blocks at the survey's own best parameters, total_field (n,) nT at its best."""
    data, samples = seen.data, len(seen.residual)
    many = max(min(BLOCKS, samples // LEAST_PER_BLOCK), 1)
    edges = np.linspace(0, samples, many + 1).round().astype(int)
    first = np.column_stack([np.ones(samples), seen.field])
    left = seen.residual @ _complement(seen.basis)
    parts = [slice(a, b) for a, b in pairwise(edges)]
    across = np.stack([left[p].T @ first[p] for p in parts])
    across_normal = np.stack([first[p].T @ first[p] for p in parts])
    inward = along(seen.matrix, np.zeros(3), data.y.T, total_field, data.reference_noise)
    gradient = np.stack([s.gradient for s in scores_of_blocks(inward, total_field, edges.tolist())])
    u, foot = inward.unit, inward.unit * total_field
    rows = [u[i] * foot[i] for i in range(3)] + [u[i] * foot[j] for i, j in PAIRS] + list(u)
    row = WEIGHTS[:, None] * inward.inverse_std * np.stack(rows)
    held = np.zeros(len(row))
    if data.level is not None:
        held = row @ inward.inverse_std / np.linalg.norm(inward.inverse_std)  # their mean, as `Sums.held`
        weight = np.bincount(data.level, inward.inverse_std**2)
        mean = np.stack([np.bincount(data.level, r * inward.inverse_std) for r in row]) / weight
        eliminated = (mean[:, data.level] * inward.inverse_std) * inward.residual
        gradient -= np.stack([eliminated[:, p].sum(axis=1) for p in parts])
        row -= mean[:, data.level] * inward.inverse_std
    along_normal = np.stack([row[:, p] @ row[:, p].T for p in parts])
    along_normal += np.outer(held, held) / many
    return BlockScores(
        across - np.swapaxes(across_normal @ _solved(across_normal, across.swapaxes(1, 2)), 1, 2),
        across_normal,
        gradient - along_normal @ _solved(along_normal, gradient),
        along_normal,
    )


def _solved(normal: Array, score: Array) -> Array:
    """The parameters that the sum of all blocks asks for; zero where a survey tells nothing."""
    information, wanted = normal.sum(axis=0), score.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    inverse = np.linalg.pinv(information * np.outer(scale, scale), rcond=1e-12, hermitian=True)
    out: Array = inverse * np.outer(scale, scale) @ wanted
    return out


def _complement(basis: Array) -> Array:
    """(3 S, 3 S - 3) orthonormal, perpendicular to a basis (3 S, 3)."""
    out: Array = np.linalg.qr(basis, mode="complete")[0][:, 3:]
    return out
