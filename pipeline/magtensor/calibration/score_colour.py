"""What noise of any colour does to a joint fit, from the scatter of the scores of blocks of samples.

In white noise the scores of blocks, whitened by their expected information, are independent with unit variance, and so
are their cosine transforms X_j, j = 1, 2, ... half waves over the recording. Slow noise raises those of low j: their
mean square over a group of parameters is the spectrum v(j) of its scores, and the variance of the estimate is the
spectrum at frequency zero (the long-run variance of Newey and West 1987, by cosines as Mueller 2007). Groups, because
noise meets parameters through the samples' motion: noise slower than the motion passes the offsets undiminished, the
elements of the matrices hardly at all.

- Across the plane: the offsets; the elements that multiply the field, less its mean.
- Along the field: the common scale, which a wrong total field moves; the offsets; the rest of the ellipsoid.

A group whose spectrum passes for that of white noise keeps its variance exactly: tests of all frequencies, of the
lowest quarter and of the lowest sixteenth, with a false alarm in `FALSE_ALARM` of all fits. Otherwise v is fitted by a
white level, 1/f, 1/f^2 and relaxations, and is never less than white. The two laws end at a period of four times the
recording: what is slower still counts as the value of the parameter. Scores divided by sqrt(v) tell how the slow noise
is shared among a group (one output may have it and others not) and what two groups have in common, drawn toward equal
and independent shares by as much as chance explains.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .blocks import BlockScores
from .mixture import likeliest_mixture
from .types import Array

FALSE_ALARM = 0.01  # of fits in white noise are widened
LEAST_BLOCKS = 16  # with fewer the noise is taken as white
SHARES = (1, 4, 16)  # of the lowest frequencies, that are tested
OUTPUTS, FIELD, SCALE, CENTRE, SHAPE = "offsets across", "elements across", "scale", "offsets along", "shape"
_LONGEST = (0.570, 0.756)  # integral of sinc^2(j/2) over 1/j and 1/j^2 from j = 1/2


@dataclass(frozen=True)
class ScoreColour:
    """The covariance (P, P) of the whitened scores, P = 12 S - 3, where white noise of unit variance has the identity.

    Attributes:
        covariance: in the order across the plane, direction by direction with its four parameters; then along.
        widened: factor on the variance of each group of parameters; 1 where white.
    """

    covariance: Array
    widened: dict[str, float]


@dataclass(frozen=True)
class Whitening:
    """x = root^-1 turn' score for either part; the covariance of the parameters is turn root^-T cov(x) root^-1 turn'.

    Attributes:
        across_turn: (4, 4) from (1, field) to (field, 1); across_root: (4, 4) lower triangular.
        along_turn: (9, 9), columns the scale, the offsets, and what shape is left; along_root: (9, 9).
    """

    across_turn: Array
    across_root: Array
    along_turn: Array
    along_root: Array

    @property
    def across(self) -> Array:
        """(4, 4): parameters (field, 1) from whitened scores."""
        out: Array = self.across_turn @ np.linalg.inv(self.across_root).T
        return out

    @property
    def along(self) -> Array:
        """(9, 9): parameters of `Scores` from whitened scores."""
        out: Array = self.along_turn @ np.linalg.inv(self.along_root).T
        return out


def whitening(moments: Array, normal: Array) -> Whitening:
    """From the moments (4, 4) of (field, 1) and the information (9, 9) of `Scores`, over all samples.

    A drift of all offsets, or of the total field, then moves one score of each block, and the rest is orthogonal to it.
    """
    last_first = np.eye(4)[:, [3, 0, 1, 2]]
    turn = np.zeros((9, 9))
    turn[:3, 0] = 1.0
    turn[6:, 1:4] = np.eye(3)
    turn[:3, 4], turn[:3, 5] = (1.0, -1.0, 0.0), (1.0, 1.0, -2.0)
    turn[3:6, 6:] = np.eye(3)
    return Whitening(
        last_first,
        _root(last_first.T @ moments @ last_first),
        turn,
        _root(turn.T @ normal @ turn),
    )


def _root(information: Array) -> Array:
    """Lower triangular; of a direction without information the root of next to none."""
    scale = np.sqrt(np.diag(information))
    scaled = information / np.outer(scale, scale)
    try:
        root = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(scaled)
        root = np.linalg.cholesky((vectors * np.maximum(values, 1e-12)) @ vectors.T + 1e-13 * np.eye(len(scaled)))
    out: Array = root * scale[:, None]
    return out


def colour_of_scores(
    blocks: BlockScores, chi2_across: float, chi2_along: float, false_alarm: float = FALSE_ALARM
) -> ScoreColour | None:
    """The covariance of the scores; None where white noise explains their scatter, or there are too few blocks.

    Parameters
    ----------
    chi2_across, chi2_along: mean square of the samples' whitened residuals, which the blocks' are compared with.
    false_alarm: chance that white noise is called coloured.
    """
    from scipy.fft import dct

    many = len(blocks.along)
    if many < LEAST_BLOCKS:
        return None
    order = np.eye(4)[:, [3, 0, 1, 2]]
    white = whitening(order @ blocks.across_normal.sum(axis=0) @ order.T, blocks.along_normal.sum(axis=0))
    out_root, in_root = np.linalg.inv(white.across_root), np.linalg.inv(white.along_root) @ white.along_turn.T
    outside = (blocks.across @ out_root.T).reshape(many, -1)
    scores = np.concatenate([outside, blocks.along @ in_root.T], axis=1)
    shares = (out_root @ blocks.across_normal @ out_root.T, in_root @ blocks.along_normal @ in_root.T)
    scores -= scores.mean(axis=0)
    waves = dct(scores, axis=0, norm="ortho")[1:] * np.sqrt(many)
    groups = _groups(blocks.across.shape[1])
    chance = false_alarm / (len(groups) * len(SHARES))
    widened = dict.fromkeys(groups, 1.0)
    slow: dict[str, _Slow] = {}
    turned, levels = np.eye(waves.shape[1]), (1.0, max(chi2_along, 1.0))
    for name, (places, part, inside) in groups.items():
        share = shares[part][:, inside][:, :, inside]
        # across the plane the noise that is known is the white level; along the field it is what the samples scatter by
        chi2, level = (chi2_across, chi2_along)[part], levels[part]
        turned[places, places] = np.sqrt(level)
        if not chi2 > 0:
            continue
        own = waves[:, places] / np.sqrt(chi2 * _expected(share))[:, None]
        trace = np.trace(share, axis1=1, axis2=2)
        freedom = len(places) * float(trace.sum() ** 2 / (many * np.sum(trace**2)))
        spectrum = np.mean(own**2, axis=1)
        if not _is_coloured(spectrum, freedom, chance):
            continue
        found, at_zero = fitted_spectrum(spectrum, freedom)
        if at_zero * chi2 > level:
            widened[name] = at_zero * chi2 / level
            slow[name] = _Slow.of(own, found, level / chi2, widened[name])
    if not slow:
        return None
    pulled, rest = np.zeros_like(waves), np.ones(waves.shape[1])
    for family in ((OUTPUTS, CENTRE), (FIELD, SCALE, SHAPE)):
        members = [slow[name] for name in family if name in slow]
        alike = _alike(members)
        for name in (n for n in family if n in slow):
            places = groups[name][0]
            pulled[:, places], rest[places] = slow[name].scaled * np.sqrt(1.0 - alike), alike
            turned[np.ix_(places, places)] = slow[name].turn(alike) * np.sqrt(levels[groups[name][1]])
    return ScoreColour(turned @ (pulled.T @ pulled + np.diag(rest)) @ turned.T, widened)


@dataclass(frozen=True)
class _Slow:
    """The slow noise of a group of d parameters.

    Attributes:
        scaled: (M, d) cosine transforms, of unit variance when summed over M; weight: (M,) what each has in that.
        white: the part of this variance that white noise has.
        widened: variance of the estimate over that in white noise, mean of the group.
    """

    scaled: Array
    weight: Array
    white: float
    widened: float

    @classmethod
    def of(cls, waves: Array, found: Array, white: float, widened: float) -> _Slow:
        """Waves (M, d) whose variance is found (M,), of which white noise has `white`."""
        weight = np.maximum(1.0 - white / found, 0.0) + 1e-3
        weight /= weight.sum()
        part = float(np.sum(weight * np.minimum(white / found, 1.0)))
        return cls(waves * np.sqrt(weight / found)[:, None], weight, part, widened)

    def turn(self, alike: float) -> Array:
        """(d, d) that gives scores of unit variance, a part of it `alike`, the covariance 1 + (widened - 1) K, where K,
        of mean one, is their covariance without what white noise has in it."""
        size = self.scaled.shape[1]
        own = (1.0 - alike) * self.scaled.T @ self.scaled + alike * np.eye(size)
        values, vectors = np.linalg.eigh(own)
        slow = np.maximum(values - self.white, 0.0)
        slow = slow * size / slow.sum() if slow.sum() > 0 else np.ones(size)
        out: Array = (vectors * np.sqrt((1.0 + (self.widened - 1.0) * slow) / np.maximum(values, 1e-9))) @ vectors.T
        return out


def _alike(members: list[_Slow]) -> float:
    """The part of the correlation between all parameters of some groups, and of the differences of their variances,
    that chance explains (Ledoit and Wolf 2004)."""
    if not members:
        return 1.0
    scaled = np.concatenate([m.scaled for m in members], axis=1)
    size = [m.scaled.shape[1] for m in members]
    away = float(np.sum((scaled.T @ scaled - np.eye(sum(size))) ** 2))
    chance = sum(a * b * float(m.weight @ n.weight) for a, m in zip(size, members, strict=True)
                 for b, n in zip(size, members, strict=True))  # fmt: skip
    chance += sum(a * float(m.weight @ m.weight) for a, m in zip(size, members, strict=True))
    return min(1.0, chance / max(away, 1e-300))


def _groups(directions: int) -> dict[str, tuple[NDArray[np.intp], int, NDArray[np.intp]]]:
    """Of each group the places among all whitened scores, the part (0 across, 1 along), and the places in its own
    information."""
    each, start = np.arange(directions), 4 * directions
    across = {
        OUTPUTS: (4 * each, 0, np.array([0])),
        FIELD: ((4 * each[:, None] + np.arange(1, 4)).ravel(), 0, np.arange(1, 4)),
    }
    along = {
        name: (start + own, 1, own) for name, own in ((SCALE, np.arange(1)), (CENTRE, np.arange(1, 4)),
                                                      (SHAPE, np.arange(4, 9)))
    }  # fmt: skip
    return (across if directions else {}) | along


def _expected(share: Array) -> Array:
    """(B - 1,) mean variance of the cosine transforms in white noise, from the blocks' shares (B, d, d) of the
    information: the fit has taken off what the parameters explain."""
    from scipy.fft import dct

    many, size = share.shape[:2]
    waves = np.sqrt(2.0) * np.cos(np.pi * np.outer(np.arange(1, many), np.arange(many) + 0.5) / many)
    own = waves**2 @ np.trace(share, axis1=1, axis2=2)
    met = dct(share.reshape(many, -1), axis=0, norm="ortho")[1:] * np.sqrt(many)
    out: Array = np.maximum(own - np.sum(met**2, axis=1), 0.01 * own) / size
    return out


def _is_coloured(spectrum: Array, freedom: float, level: float) -> bool:
    """Whether the lowest frequencies hold more than white noise of variance one gives them."""
    from scipy.special import chdtrc

    for share in SHARES:
        lowest = spectrum[: max(len(spectrum) // share, 1)]
        if chdtrc(freedom * len(lowest), freedom * float(lowest.sum())) < level:
            return True
    return False


def fitted_spectrum(spectrum: Array, freedom: float) -> tuple[Array, float]:
    """White noise, 1/f, 1/f^2 and relaxations fitted to ordinates j = 1, 2, ...: their sum there (M,), and the variance
    that it gives the mean over the recording, where white noise of unit power gives one."""
    count = len(spectrum)
    half_waves = np.arange(1, count + 1)
    corners = 2.0 ** np.arange(0, int(np.log2(count)))
    shapes = np.column_stack(
        [np.ones(count), 1.0 / half_waves, 1.0 / half_waves**2]
        + [1.0 / (1.0 + (half_waves / corner) ** 2) for corner in corners]
    )
    at_zero = np.array([1.0, *_LONGEST, *(1.0 - (1.0 - np.exp(-np.pi * corners)) / (np.pi * corners))])
    edges = np.unique(np.round(np.geomspace(1, count + 1, 24)).astype(int)) - 1
    level = np.array([spectrum[a:b].mean() for a, b in pairwise(edges)])
    mean_shapes = np.array([shapes[a:b].mean(axis=0) for a, b in pairwise(edges)])
    found, _ = likeliest_mixture(level, freedom * np.diff(edges), mean_shapes)
    return np.maximum(shapes @ found, 1e-3 * spectrum.mean()), float(at_zero @ found)
