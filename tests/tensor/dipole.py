"""Field and gradient tensor of a point dipole, written for the tests from the textbook formulas."""

import numpy as np

MU0_OVER_4PI = 1e-7 * 1e9  # nT m / A


def dipole_field(point, moment):
    """nT at `point` (..., 3) m of a dipole `moment` (3,) A m^2 at the origin."""
    r = np.linalg.norm(point, axis=-1, keepdims=True)
    n = point / r
    return MU0_OVER_4PI * (3 * n * (n @ moment)[..., None] - moment) / r**3


def dipole_tensor(point, moment):
    """dB_i/dx_j in nT/m at `point` (3,) m."""
    r = np.linalg.norm(point)
    n = point / r
    along = n @ moment
    shape = along * np.eye(3) + np.outer(n, moment) + np.outer(moment, n) - 5 * along * np.outer(n, n)
    return 3 * MU0_OVER_4PI / r**4 * shape


def random_rotations(rng, count):
    """(count, 3, 3), uniform on SO(3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.random(count, random_state=rng).as_matrix()
