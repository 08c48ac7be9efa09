"""How unlikely it is that chance explains as much as terms do: what settings are profiled and models ranked by."""

from __future__ import annotations

from collections.abc import Sequence
from math import lgamma, log

from magtensor.error_models.terms import Terms
from magtensor.loop.evidence.assessment import Colours, estimated_in
from magtensor.loop.evidence.columns import Made
from magtensor.loop.evidence.estimate import explained_beside_each
from magtensor.loop.evidence.grams import Whitened, grams_of_each
from magtensor.loop.evidence.residual import Residual


class Scorer:
    """How unlikely it is that as many random regressors explain as much beyond the adopted terms: -log of chance."""

    def __init__(self, residual: Residual, adopted: Terms | None, colours: Colours) -> None:
        self.white = Whitened.of(residual, colours.across, colours.along, adopted, over_time=False)
        self.known = None if adopted is None else estimated_in(self.white, None)

    def __call__(self, terms: Terms) -> float:
        return self.of_each([terms])[0]

    def of_each(self, several: Sequence[Terms], made: Made | None = None) -> list[float]:
        """The same of several sets of terms that differ in their series only, and of what is made of them."""
        found, ranks = explained_beside_each(grams_of_each(self.white, several, made), self.known)
        return [rarity(e, max(rank, 1)) for e, rank in zip(found, ranks, strict=True)]


def rarity(explained: float, rank: int) -> float:
    """-log of the probability that chi-square with `rank` degrees of freedom exceeds a value, however small that is."""
    from scipy.special import chdtrc

    tail = float(chdtrc(rank, max(explained, 0.0)))
    if tail > 1e-250:
        return -log(tail)
    half = explained / 2.0
    return half - (rank / 2.0 - 1.0) * log(half) + lgamma(rank / 2.0)
