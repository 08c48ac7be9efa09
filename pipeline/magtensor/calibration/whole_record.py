"""From the fit of a selection to that of the whole recording, in one reading of it.

Everything that the recording has to say at given parameters are sums: the first and second moments of the outputs,
whitened and turned so that three of them are the plane's own coordinates, and the scores of the scalar part. The
moments give the plane in closed form. The scalar part takes one scoring step, whose error is of second order in its
length; a selection of n samples starts it some sqrt(9 N / n) standard deviations away, which at any usual
signal-to-noise ratio one step turns into less than a hundredth. Where that cannot be promised the recording is read
again. Samples that no noise explains are left out on the way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magtensor.errors import DataError, NotEnoughData

from .blocks import Blocks, length_of
from .common_field import CommonField
from .maximum_likelihood import CHUNK, Along, ScalarFit, along, scoring_step, stepped
from .recording import Recording, even_samples, pieces
from .types import Array, Mask

NEGLIGIBLE = 0.01  # of a standard deviation
PICKED = 4_096  # samples kept from the whole recording to judge its attitudes by
_MOST_READINGS = 8


@dataclass(frozen=True)
class Limits:
    """The largest squared whitened residuals that are believed, along the field and across the plane."""

    along: float
    across: float


@dataclass(frozen=True)
class Whole:
    """The fit of a whole recording.

    Attributes:
        keep: (N,) samples used; doubted among the usable are those left out.
        raw, total_field: the samples picked for judging the attitudes, all of them used.
        blocks: sums over blocks of samples.
    """

    plane: CommonField
    scalar: ScalarFit
    keep: Mask
    raw: Array
    total_field: Array
    blocks: Blocks


def fit_whole(
    recording: Recording,
    plane: CommonField,
    scalar: ScalarFit,
    *,
    limits: Limits | None,
    reference_noise: float,
    keep: Mask | None,
) -> Whole:
    """The fit of all samples, from that of a selection.

    Parameters
    ----------
    limits: for samples to believe; all are when None.
    keep: (N,) samples that may be used; all when None.

    Raises
    ------
    NotEnoughData: more than half of the samples disagree with the fit, or it does not settle.
    DataError: a value that is not finite.
    """
    for _ in range(_MOST_READINGS):
        sums = Blocks.of(plane)
        read = _read(recording, plane, scalar, limits, reference_noise, keep, sums)
        plane, scalar, left = _solved(sums, plane, scalar)
        if left < NEGLIGIBLE:
            return Whole(plane, scalar, *read, sums)
    raise NotEnoughData(
        "the fit of the whole recording does not settle", hint="look for disturbed samples, or add attitudes"
    )


def _read(
    recording: Recording,
    plane: CommonField,
    scalar: ScalarFit,
    limits: Limits | None,
    reference_noise: float,
    keep: Mask | None,
    sums: Blocks,
) -> tuple[Mask, Array, Array]:
    """One reading: the sums are filled; which samples were used, and those picked."""
    used = np.ones(recording.count, dtype=bool) if keep is None else keep.copy()
    allowed = recording.count if keep is None else int(keep.sum())
    picked = even_samples(recording.count, PICKED)
    picks: list[tuple[Array, Array]] = []
    offset = scalar.offset - sums.centre[:3]
    length = length_of(recording.count)
    for where, raw, total_field in pieces(recording):
        flat = raw.reshape(len(raw), -1)
        for start in range(0, len(raw), CHUNK):
            part = slice(start, start + CHUNK)
            here = used[where][part]
            z, reference = sums.turn @ flat[part].T, total_field[part]
            if not here.all():
                z, reference = z[:, here], reference[here]
            if not len(reference):
                continue
            z -= sums.centre[:, None]
            seen = along(scalar.matrix, offset, z[:3], reference, reference_noise)
            if limits is not None:
                good = _believed(seen, z, limits)
                if not good.all():
                    good |= ~np.isfinite(seen.residual)
                    here[here] = good
                    z, reference = z[:, good], reference[good]
                    seen = along(scalar.matrix, offset, z[:3], reference, reference_noise)
            edges = [*range(0, len(here), length), len(here)]
            if len(reference) < len(here):
                edges = np.append(0, np.cumsum(here))[edges].tolist()
            sums.add((where.start + start) // length, edges, z, seen, reference)
        own = picked[np.searchsorted(picked, where.start) : np.searchsorted(picked, where.stop)]
        own = own[used[own]] - where.start
        picks.append((raw[own], total_field[own]))
    if used.sum() < 0.5 * allowed:
        raise NotEnoughData(
            "more than half of the samples disagree with any one calibration",
            hint="look for a moving magnetic object, a dead axis or wrong units",
        )
    return used, np.concatenate([raw for raw, _ in picks]), np.concatenate([field for _, field in picks])


def _believed(seen: Along, z: Array, limits: Limits) -> Mask:
    good: Mask = np.abs(seen.residual) <= np.sqrt(limits.along)
    if len(z) > 3:
        good &= np.einsum("in,in->n", z[3:], z[3:]) <= limits.across
    return good


def _solved(sums: Blocks, plane: CommonField, scalar: ScalarFit) -> tuple[CommonField, ScalarFit, float]:
    """The plane and the calibration in it that these sums ask for, and a bound, in standard deviations, of what
    is left to go (5 to 100 times what a further reading finds).

    Raises
    ------
    DataError: a value that is not finite.
    """
    total, square, scores = sums.summed()
    if not np.isfinite(scores.cost + total.sum()):
        raise DataError("the samples are not all finite", hint="mask the gaps before calibrating")
    count, size = scores.samples, len(sums.axes)
    mean = total / count
    moments = square / count - np.outer(mean, mean)
    step, expected = scoring_step(scores)
    matrix, offset = stepped(scalar.matrix, scalar.offset - sums.centre[:3], step)
    after = replace(scores, cost=max(scores.cost - expected, 0.0), gradient=np.zeros(9))
    reach = np.sqrt(np.mean(np.diag(after.moments)[:3] * 3.0) / count)
    relative = max(np.abs(step[:6]).max(), np.abs(step[6:]).max() / reach)
    noise_share = np.sqrt(scores.cost / np.trace(after.normal[6:, 6:])) / reach
    # a step's error is of second order in its length, and of first order in the noise that scoring expects away
    left = float(np.sqrt(max(expected, 0.0)) * (relative + noise_share))
    turned = np.eye(size, 3)
    chi2 = plane.chi2
    if size > 3:
        # among all bases of the new plane the one nearest to the old: then the scalar part only follows it
        leading = np.linalg.eigh(moments)[1][:, -3:]
        u, _, vt = np.linalg.svd(leading[:3])
        turned = leading @ vt.T @ u.T
        follow = turned[:3].T
        matrix, offset = matrix @ np.linalg.inv(follow), follow @ offset
        across = moments[3:, 3:] - moments[3:, :3] @ np.linalg.solve(moments[:3, :3], moments[:3, 3:])
        chi2 = float(np.trace(across)) / ((size - 3) * (count - 4) / count)
        tilt = float(np.linalg.norm(turned[3:], 2))
        left = max(left, tilt * np.sqrt(chi2 * count))
    basis = sums.axes @ turned
    offset = offset + turned[3:].T @ mean[3:] + basis.T @ plane.mean
    moved = CommonField(plane.noise, basis, plane.mean + sums.axes @ mean, count, chi2)
    return moved, ScalarFit(matrix, offset, after.cost / max(count - 9, 1), after), left
