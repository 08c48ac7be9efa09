"""Which error models the end of a search leaves under suspicion: significant ones that were not adopted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from magtensor.calibration.types import Mask
from magtensor.error_models.terms import joined
from magtensor.loop.evidence.assessment import assess, estimated
from magtensor.loop.evidence.grams import Whitened
from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.evidence.residual import taken_off
from magtensor.loop.fitting.model import State
from magtensor.loop.fitting.separation import SECOND_ORDER
from magtensor.loop.remainder.sparse_readings import SparseReadings
from magtensor.loop.searching.beside_a_hole import OF_A_HOLE
from magtensor.loop.searching.between_readings import BETWEEN
from magtensor.loop.searching.contribution import happens_once, moments
from magtensor.loop.searching.found import Search
from magtensor.loop.searching.gates import Candidate
from magtensor.loop.searching.keeping import NOT_AS_ASSUMED

ALPHA = 0.001  # of noise that explains a model, whatever the model predicts
NEAR = 0.05  # corrected p value of what is said to come near
MOST_NEAREST = 5
LEAST_SHOWN = 1e-6  # of the largest singular value, of series beside the field


@dataclass(frozen=True)
class Suspects:
    """What the candidates of the last round say of what is left: names of models; "another" one is adopted already.

    Attributes:
        open: those that pass the first two gates and were refused, with the reason; useless: significant ones that do
            not pass.
        small: so small beside what is adopted that its law may miss as much.
        noise: of the base station, whose noise, or the field between its readings, looks like them.
        nearest: those that come nearest to explaining it, most significant first.
    """

    open: list[str]
    useless: list[str]
    small: list[str]
    noise: list[str]
    nearest: list[str]

    @classmethod
    def of(
        cls,
        found: Search,
        flagged: Mask,
        known: Mask,
        sparse: SparseReadings | None,
        loud: Sequence[tuple[float, float]],
        alike: bool,
    ) -> Suspects:
        """Of a search that has ended.

        Parameters
        ----------
        flagged: (N,) samples that no calibration fits; known: (N,) the same of which it is known why.
        loud: begin and end, s after the start, of louder noise: an event in it that predicts nothing is a part of that.
        alike: whether all sensors see what is left alike.
        """
        last = found.steps[-1].candidates if found.steps else ()
        last = tuple(c for c in last if c.passes or not _in_one_of(loud, c))
        refused = found.steps[-1].refused if found.steps else {}
        seen = [c for c in last if c.passes or unlikely(c)]
        if flagged.any() or known.any():  # while effects were sought, what lasts was believed
            seen = [c for c in seen if _still_significant(c, found.told)]
        if known.any():
            last = tuple(c for c in last if _still_significant(c, found.told, NEAR))
        reference = [c for c in last if c.model.component.effect == "reference"]
        noisy = {c.model.name for c in reference if refused.get(c.model.name) == NOT_AS_ASSUMED}
        noisy |= {name for name, why in refused.items() if why in (BETWEEN, OF_A_HOLE)}
        if sparse is not None:
            noisy |= {c.model.name for c in reference if not c.passes}
        suspects = [
            c for c in seen
            if c.model.name not in noisy and not (c.of_the_log or c.of_second_order or c.of_the_law)
            and (c.passes or not (alike and seen_alike_alone(c, found.told)))
            and (c.passes or not within_the_noise_there(c, found.told))
        ]  # fmt: skip
        adopted = {a.name for a in found.last.adopted}

        def named(candidate: Candidate) -> str:
            name, when = candidate.model.name, [f"{t:.4g}" for t in moments(candidate.model)]
            at = f" from {when[0]} to {when[1]} s" if len(when) == 2 else f" at {when[0]} s" if when else ""
            return f"{'another ' * (name in adopted)}{name}{at}"

        open_ = [(c, refused.get(c.model.name, "")) for c in suspects if c.passes]
        near = sorted((c for c in last if c.adjusted_p < NEAR), key=lambda c: c.adjusted_p)
        return cls(
            _by_reason([(named(c), why) for c, why in open_]),
            [named(c) for c in suspects if not c.passes],
            [c.model.name for c in seen if c.model.name not in noisy and c.of_second_order],
            [c.model.name for c in seen if c.model.name in noisy],
            [c.model.name for c in near if sparse is None or c.model.name not in noisy][:MOST_NEAREST],
        )

    @property
    def words(self) -> list[str]:
        """Those that make something unexplained."""
        words = []
        if self.open:
            words.append(f"significant, predicts held-out blocks and is not adopted: {', '.join(self.open)}")
        if self.useless:
            words.append(f"significant but of no use on held-out blocks: {', '.join(self.useless)}")
        return words

    @property
    def noise_words(self) -> list[str]:
        """Those that the noise of the base station makes."""
        if not self.noise:
            return []
        return [
            f"{' and '.join(self.noise)}: significant, but as noise of the base station, or the field between its "
            "readings, would make it"
        ]

    @property
    def small_words(self) -> list[str]:
        """Those that the law of what is adopted may leave."""
        if not self.small:
            return []
        return [
            f"{' and '.join(self.small)}: significant, and less than {SECOND_ORDER**0.5:.1%} of the size of what is "
            "adopted, whose law may miss as much"
        ]


def _by_reason(refused: Sequence[tuple[str, str]]) -> list[str]:
    """Names and the reason against each, in words: a reason is given once, behind the names that it holds for."""
    names: dict[str, list[str]] = {}
    for name, why in refused:
        names.setdefault(why, []).append(name)
    plain = names.pop("", [])
    listed = ((" and ".join(filter(None, (", ".join(each[:-1]), each[-1]))), why) for why, each in names.items())
    return [f"{several} ({why})" for several, why in listed] + plain


def _in_one_of(stretches: Sequence[tuple[float, float]], candidate: Candidate) -> bool:
    """Whether what happened once did so within one stretch."""
    when = moments(candidate.model) if happens_once(candidate.model) else []
    return bool(when) and any(begin <= when[0] and when[-1] <= end for begin, end in stretches)


def seen_alike_alone(candidate: Candidate, state: State) -> bool:
    """Whether an event of the sensors is asked for by |b| - F alone: where all of what is left there is seen by all of
    them alike, the base station errs, or a field that it does not see moves."""
    residual = state.residual
    if residual.across is None:  # of one sensor nothing else is seen
        return False
    if not (happens_once(candidate.model) and candidate.model.component.effect == "instrument"):
        return False
    terms = candidate.model.terms(state.excitation).at(residual.samples)
    between = OwnNoise(replace(residual, along=None, sighted=None), state.terms).p_value(terms)
    return between * _corrected(candidate) >= candidate.alpha


def within_the_noise_there(candidate: Candidate, state: State) -> bool:
    """Whether what happened once is no more than the noise at the samples that tell of it, where that is louder than
    the average: by so much less of it shows.

    Those tell of it in which its terms have something that C and o could not follow.
    """
    from scipy.special import chdtrc, chdtri

    residual, p = state.residual, _p(candidate)
    if not happens_once(candidate.model) or p <= 0.0:
        return False
    terms = candidate.model.terms(state.excitation).at(residual.samples)
    together = terms if state.terms is None else joined([state.terms, terms])
    left = taken_off(residual, together, estimated(residual, together, state.colours).theta)
    parts = [part.reshape(len(part), -1) for part in (left.across, left.along) if part is not None]
    square = np.sum(np.hstack(parts) ** 2, axis=1)
    known = np.linalg.qr(residual.affine)[0]
    beside = terms.series - known @ (known.T @ terms.series)
    rows, size, _ = np.linalg.svd(beside, full_matrices=False)
    tells = np.sum(rows[:, size > LEAST_SHOWN * size[0]] ** 2, axis=1)
    louder = float(tells @ square) / max(float(tells @ (1.0 - tells)) * float(square.mean()), 1e-300)
    if louder <= 1.0:
        return False
    return float(chdtrc(terms.count, chdtri(terms.count, p) / louder)) * _corrected(candidate) >= candidate.alpha


def _p(candidate: Candidate) -> float:
    return max(candidate.assessment.p, candidate.assessment.own_p)


def _corrected(candidate: Candidate) -> float:
    """By what factor a p value grows for all that was tried."""
    p = _p(candidate)
    return max(candidate.adjusted_p, candidate.adjusted_own_p) / p if p > 0.0 else candidate.tried


def unlikely(candidate: Candidate) -> bool:
    """Whether no noise explains a model, whatever it predicts."""
    return max(candidate.adjusted_p, candidate.adjusted_own_p) < candidate.alpha and candidate.adjusted_null_p < ALPHA


def _still_significant(candidate: Candidate, state: State, alpha: float | None = None) -> bool:
    """Whether a model is asked for by the samples that are still in use, at the level of the search or another."""
    terms = candidate.model.terms(state.excitation).at(state.residual.samples)
    white = Whitened.of(state.residual, state.colours.across, state.colours.along, state.terms)
    now = assess(white, terms, once=happens_once(candidate.model))
    p = max(now.p, now.own_p)
    return p * candidate.tried < (alpha or candidate.alpha) and now.null_p * candidate.tried < ALPHA
