"""What moves and what remembers: smooth random functions of time, the first-order lag, the play operator.

The first-order lag tau x' + x = u stands behind every inert thing of the simulator: a thermal mass, an eddy
current (the lagged field minus the field), a low-pass filter, viscous magnetisation.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from magtensor.simulate.spec import Array

# Mean squares of a uniform cubic B-spline and of its slope, per unit knot distance.
SPLINE_POWER = 151 / 315
SPLINE_SLOPE_POWER = 2 / 3


class SmoothRandom:
    """A Gaussian random function of time, twice continuously differentiable: a cubic B-spline on even knots.

    Args:
        rng: where its coefficients come from.
        span: (first, last) time in s at which it may be asked.
        knot_s: distance of the knots, about the correlation time.
        rms: of each component, over an infinite time.
        components: number of independent functions.
    """

    def __init__(
        self, rng: np.random.Generator, span: tuple[float, float], knot_s: float, rms: float, components: int
    ) -> None:
        self.start, self.knot_s = span[0], knot_s
        count = int(np.ceil((span[1] - span[0]) / knot_s)) + 4
        self.coefficients = rng.standard_normal((count, components)) * (rms / np.sqrt(SPLINE_POWER))

    def __call__(self, t: Array) -> Array:
        """(n, components) at times (n,) s."""
        u = (t - self.start) / self.knot_s
        i = np.floor(u).astype(int)
        if i.size and (i.min() < 0 or i.max() + 4 > len(self.coefficients)):
            raise ValueError("asked outside its span")
        f = u - i
        weights = ((1 - f) ** 3, (3 * f - 6) * f * f + 4, ((-3 * f + 3) * f + 3) * f + 1, f**3)
        out = np.zeros((len(t), self.coefficients.shape[1]))
        for j, weight in enumerate(weights):
            out += self.coefficients[i + j] * (weight / 6)[:, None]
        return out


def low_pass(
    u: Callable[[Array], Array], time: Array, tau_s: Array | float, *, substeps: int = 2, chunk: int = 1 << 15
) -> Array:
    """Solve tau x' + x = u(t) and give x at the times asked.

    Between three neighbouring points u is taken as a parabola, for which the solution is exact. So tau may be
    far below or far above the step.

    Args:
        u: function of times (n,) that gives (n, ...).
        time: (N,) s, evenly spaced. Before the first one u is taken as constant.
        tau_s: s, a number or an array that broadcasts against u's trailing dimensions; 0 gives u itself.
        substeps: parabolas per sample interval.
        chunk: sample intervals computed at once; no influence on the result.

    Returns:
        (N, ...).
    """
    from scipy.signal import lfilter

    first = u(time[:1])
    x = np.empty((len(time), *first.shape[1:]))
    x[0] = first[0]
    if len(time) == 1:
        return x
    tau = np.broadcast_to(np.asarray(tau_s, dtype=float), first.shape[1:])
    step = (time[-1] - time[0]) / (len(time) - 1) / substeps
    decay, weights = _parabola_response(tau, step)
    for begin in range(0, len(time) - 1, chunk):
        intervals = min(chunk, len(time) - 1 - begin)
        fine = time[0] + (2 * substeps * begin + np.arange(2 * substeps * intervals + 1)) * (step / 2)
        values = u(fine)
        drive = weights[0] * values[:-1:2] + weights[1] * values[1::2] + weights[2] * values[2::2]
        for index in np.ndindex(tau.shape):
            a, column = float(decay[index]), (slice(None), *index)
            solved, _ = lfilter([1.0], [1.0, -a], drive[column], zi=[a * x[(begin, *index)]])
            x[(slice(begin + 1, begin + intervals + 1), *index)] = solved[substeps - 1 :: substeps]
    return x


def _parabola_response(tau: Array, step: float) -> tuple[Array, Array]:
    """Decay over one step, and the weights (3, ...) of u at its begin, middle and end.

    With z = step / tau the response is z times the integral of exp(-z (1 - s)) u(s) over s in (0, 1); the moments
    M_k of that kernel follow from M_(k+1) = 1 - (k + 1) M_k / z, or for small z, where that cancels, from the series.
    """
    z = step / np.where(tau > 0, tau, step * 1e-30)  # 0: so short that only the end of the step counts
    small = np.minimum(z, 1.0)
    series = [np.zeros_like(z) for _ in range(3)]
    for k in range(3):
        term = small / (k + 1)
        for j in range(1, 24):
            series[k] = series[k] + term
            term = -term * small / (k + 1 + j)
    m0 = -np.expm1(-z)
    m1 = np.where(z < 1, series[1], 1 - m0 / z)
    m2 = np.where(z < 1, series[2], 1 - 2 * m1 / z)
    m0 = np.where(z < 1, series[0], m0)
    return np.exp(-z), np.stack([m0 - 3 * m1 + 2 * m2, 4 * (m1 - m2), 2 * m2 - m1])


def play(u: Array, half_width: float, state: Array | None = None) -> Array:
    """The play (backlash) operator: the output follows u (n, k) only where u pushes it by more than the half width.

    p_i = min(max(p_(i-1), u_i - r), u_i + r). Clamps compose to clamps, so it runs in about 2 sqrt(n)
    vectorised steps, and without rounding.

    Args:
        state: (k,) output before the first sample; the first input where None.
    """
    n, k = u.shape
    length = max(1, int(np.sqrt(n)))
    blocks = -(-n // length)
    low = np.full((blocks * length, k), -np.inf)
    high = np.full((blocks * length, k), np.inf)
    low[:n], high[:n] = u - half_width, u + half_width
    low, high = low.reshape(blocks, length, k), high.reshape(blocks, length, k)
    for i in range(1, length):
        a, b = low[:, i].copy(), high[:, i].copy()
        low[:, i] = np.clip(low[:, i - 1], a, b)
        high[:, i] = np.clip(high[:, i - 1], a, b)
    out = np.empty((blocks, length, k))
    carry = u[0] if state is None else state
    for block in range(blocks):
        out[block] = np.clip(carry, low[block], high[block])
        carry = out[block, -1]
    return out.reshape(-1, k)[:n]
