"""What a second function of a channel gains of the noise of its log is no effect; what gains far more may be one."""

from __future__ import annotations

import pytest
from scipy.stats import ncx2

from magtensor.loop.gates import gained_of_a_log


@pytest.mark.parametrize("log_noise", [1.0, 30.0, 300.0])
@pytest.mark.parametrize("coefficients", [3, 12])
def test_noise_seldom_gains_more_and_an_effect_beside_it_does(log_noise: float, coefficients: int) -> None:
    limit = gained_of_a_log(log_noise, coefficients)
    assert ncx2.sf(limit, coefficients, log_noise) < 0.02
    assert ncx2.sf(limit, coefficients, 2.0 * log_noise + 100.0) > 0.99


def test_without_noise_nothing_is_gained() -> None:
    assert gained_of_a_log(0.0, 12) == 0.0
