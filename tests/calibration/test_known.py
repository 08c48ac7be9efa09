"""To what |b| is known: against fits to other noise, in directions seen and not seen."""

from __future__ import annotations

import numpy as np
import pytest

from magtensor.calibration.joint import calibrated, fit_joint
from magtensor.calibration.known import Known, facts_of, known_to, total_field_std
from magtensor.calibration.types import Array, ArrayCalibration

FIELD = 50_000.0
NOISE = 1.0
DRAWS = 80
SEEN, UNSEEN = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.6, -0.8])


def tilted(samples: int) -> Array:
    """(N, 3) nT: directions within 50 deg of +z, so that the lower half is never seen."""
    rng = np.random.default_rng(1)
    z = rng.uniform(np.cos(np.radians(50.0)), 1.0, samples)
    turn = rng.uniform(0.0, 2.0 * np.pi, samples)
    r = np.sqrt(1.0 - z**2)
    return FIELD * np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


def fits(field: Array) -> list[ArrayCalibration]:
    rng = np.random.default_rng(2)
    forward = np.eye(3) + rng.uniform(-0.02, 0.02, (3, 3, 3))
    offset = rng.uniform(-50.0, 50.0, (3, 3))
    clean = np.einsum("sij,nj->nsi", forward, field) + offset
    total_field = np.linalg.norm(field, axis=1)
    made = (clean + NOISE * rng.standard_normal(clean.shape) for _ in range(DRAWS))
    return [calibrated(fit_joint(raw, total_field, worst_error=1.0)) for raw in made]


def test_other_noise_moves_the_field_by_as_much_as_is_said() -> None:
    found = fits(tilted(400))
    matrix, offset = found[0].matrix, found[0].offset
    for direction in (SEEN, UNSEEN):
        raw = np.linalg.solve(matrix, FIELD * direction) + offset  # what each sensor reads there
        lengths = np.array([np.linalg.norm(c.apply(raw), axis=1) for c in found])
        said = np.mean([total_field_std(c, FIELD * direction[None])[0] for c in found], axis=0)
        # a standard deviation of 80 draws is known to 8 %: four of these
        np.testing.assert_allclose(lengths.std(axis=0, ddof=1), said, rtol=0.32)


def test_what_was_never_seen_is_told_where_it_is_worse_than_the_noise() -> None:
    field = tilted(400)
    known = known_to(fits(field)[0], field)
    assert known.seen < 0.2 * NOISE < 5.0 * NOISE < known.worst
    assert facts_of(known, NOISE)["description"].startswith("|b| is known to")
    assert facts_of(Known(0.02, 0.9), NOISE)["description"] == ""
    assert facts_of(known, NOISE)["total_field_std_nT"]["worst_direction"] == pytest.approx(known.worst)
