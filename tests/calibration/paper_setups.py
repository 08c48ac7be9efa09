"""The simulations of Chi 2017 and Li 2018 as their texts describe them, for the tests of the methods."""

from __future__ import annotations

import numpy as np

# Chi 2017, Table 1; sensor 1's psi is printed +0.025, which Table 2 contradicts
CHI_FIELD = 50_000.0
CHI_SCALE = np.array([[1.031, 0.988, 0.982], [1.082, 0.991, 0.984], [1.075, 1.021, 1.009], [1.026, 0.993, 1.042]])
CHI_BIAS = np.array([[75.0, 57, -42], [-62, 43, 39], [-33, -49, 47], [65, 51, -77]])
CHI_PSI = np.array([-0.025, 0.019, -0.014, 0.011])
CHI_PHI = np.array([0.018, -0.013, 0.027, 0.016])
CHI_THETA = np.array([-0.023, 0.021, 0.017, -0.028])
CHI_ALPHA = np.array([0.0, -0.029, 0.032, -0.028])
CHI_BETA = np.array([0.0, 0.022, -0.026, -0.034])
CHI_GAMMA = np.array([0.0, 0.024, 0.033, 0.038])
CHI_SOFT = np.array(
    [
        [[0.53, 0.17, 0.13], [0.51, 0.36, 0.14], [-0.26, 0.33, 0.41]],
        [[0.37, -0.27, 0.55], [0.22, 0.43, -0.31], [0.11, 0.38, 0.59]],
        [[0.12, -0.07, 0.19], [-0.17, 0.58, 0.22], [-0.21, 0.11, 0.13]],
        [[0.39, 0.18, 0.37], [0.14, 0.46, 0.23], [0.23, 0.17, 0.52]],
    ]
)
CHI_HARD = np.array([[1200.0, -800, 1400], [-700, 900, 1100], [1700, 1200, -300], [400, -800, 500]])

# Li 2018, Table 3
LI_FIELD = 55_000.0
LI_THETA = np.radians([-2.46, -3.88, 1.69, -2.62])
LI_PHI = np.radians([3.53, 1.73, 1.44, -1.45])
LI_PSI = np.radians([1.14, 1.55, 3.62, 2.31])
LI_SCALE = np.array([[1.312, 0.915, 0.881], [0.925, 0.943, 1.315], [0.897, 1.231, 0.888], [1.185, 1.044, 0.818]])
LI_BIAS = np.array([[351.0, 111, -208], [131, -294, 217], [201, -335, 99], [218, -334, -251]])
LI_ALPHA = np.radians([-2.93, 2.64, 2.92, 1.64])
LI_BETA = np.radians([1.75, 3.19, 1.88, 0.89])
LI_GAMMA = np.radians([2.28, 0.82, -3.05, -2.54])


def turn_x(a: float) -> np.ndarray:
    c, s = np.cos(a), np.sin(a)
    return np.array([[1, 0, 0], [0, c, s], [0, -s, c]])


def turn_y(a: float) -> np.ndarray:
    c, s = np.cos(a), np.sin(a)
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def turn_z(a: float) -> np.ndarray:
    c, s = np.cos(a), np.sin(a)
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def triangle(scale: np.ndarray, plane: float, elevation: float, psi: float) -> np.ndarray:
    """Scale factors times the non-orthogonality matrix of Chi 2017 eq. 3 and Li 2018 eq. 3."""
    rows = [
        [np.cos(elevation) * np.cos(plane), np.cos(elevation) * np.sin(plane), np.sin(elevation)],
        [0, np.cos(psi), np.sin(psi)],
        [0, 0, 1],
    ]
    return np.diag(scale) @ np.array(rows)


def chi_response() -> tuple[np.ndarray, np.ndarray]:
    """C (4, 3, 3) and offset (4, 3) nT of Chi 2017 eqs. 3-5, from the frame of sensor 1."""
    c, o = [], []
    for s in range(4):
        own = triangle(CHI_SCALE[s], CHI_PHI[s], CHI_THETA[s], CHI_PSI[s])
        turn = turn_y(CHI_GAMMA[s]) @ turn_x(CHI_BETA[s]) @ turn_z(CHI_ALPHA[s])
        c.append(own @ (np.eye(3) + CHI_SOFT[s]) @ turn)
        o.append(own @ CHI_HARD[s] + CHI_BIAS[s])
    return np.array(c), np.array(o)


def li_response() -> tuple[np.ndarray, np.ndarray]:
    """C (4, 3, 3) and offset (4, 3) nT of Li 2018, the rotations in the sense his simulation applied them."""
    c = [
        triangle(LI_SCALE[s], LI_THETA[s], LI_PHI[s], LI_PSI[s])
        @ turn_x(LI_ALPHA[s])
        @ turn_y(LI_BETA[s])
        @ turn_z(LI_GAMMA[s])
        for s in range(4)
    ]
    return np.array(c), LI_BIAS.copy()


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Unit vectors (count, 3), uniform over the sphere."""
    u = rng.normal(size=(count, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def tilted(rng: np.random.Generator, count: int, tilt_deg: float, dip_deg: float = 60.0) -> np.ndarray:
    """Field directions (count, 3) in the body: any heading, roll and pitch within +-tilt."""
    heading = rng.uniform(0, 2 * np.pi, count)
    roll, pitch = np.radians(rng.uniform(-tilt_deg, tilt_deg, (2, count)))
    dip = np.radians(dip_deg)
    north = np.array([np.cos(dip), 0.0, np.sin(dip)])
    return np.array([turn_x(r) @ turn_y(p) @ turn_z(h) @ north for h, r, p in zip(heading, roll, pitch, strict=True)])


def li_grid() -> np.ndarray:
    """The field (5832, 3) nT in the platform at Li's orientations: 20 deg steps about z, x and y."""
    dip, declination = np.radians([60.0, -7.0])
    earth = LI_FIELD * np.array([np.cos(dip) * np.cos(declination), np.cos(dip) * np.sin(declination), np.sin(dip)])
    steps = np.radians(np.arange(0, 360, 20))
    return np.array([turn_y(b) @ (turn_x(a) @ (turn_z(g) @ earth)) for a in steps for b in steps for g in steps])


def cross_components(b: np.ndarray, baseline: float) -> np.ndarray:
    """Cross differences (N, 6) nT/m of b (N, 4, 3): xx, xy = x along y, xz, yx = y along x, yy, yz."""
    x, y = b[:, 0] - b[:, 2], b[:, 1] - b[:, 3]
    return np.column_stack([x[:, 0], y[:, 0], x[:, 2], x[:, 1], y[:, 1], y[:, 2]]) / baseline


def rms(x: np.ndarray, axis: int | None = None) -> np.ndarray:
    return np.sqrt(np.mean(np.square(x), axis=axis))
