"""How the array moves: attitude and position as functions of time that can be asked at any instant.

World frame: x east, y north, z up. Attitudes are quaternions, scalar last, platform to world.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from magtensor.simulate.motion_spec import (
    EulerGridSpec,
    LimitedTiltSpec,
    MotionSpec,
    OneAxisSpec,
    PosturesSpec,
    SurveyLinesSpec,
    TumblingSpec,
)
from magtensor.simulate.processes import SPLINE_POWER, SPLINE_SLOPE_POWER, SmoothRandom
from magtensor.simulate.rotations import (
    conjugate,
    cumulative,
    exponential,
    logarithm,
    matrices,
    multiply,
    normalised,
    passive,
    quaternions,
    transform_back,
    uniform_attitudes,
)
from magtensor.simulate.spec import Array

MARGIN_S = 60.0  # how far before and after the survey an attitude is defined: delays and clock errors reach there
NOT_RECORDED = -1
# Passive rotation from east, north, up to north, east, down.
ENU_TO_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class Motion(Protocol):
    """What the simulator asks of a motion. Times are s since the start, arrays (n,)."""

    duration_s: float
    continuous: bool  # False: the attitude jumps from sample to sample, so nothing can be said about rates
    numbered: bool  # whether the segments mean something (postures, lines)

    def attitude(self, t: Array) -> Array:
        """(n, 4)."""

    def origin(self, t: Array) -> Array:
        """(n, 3) m, of the platform frame in the world."""

    def segment(self, t: Array) -> np.ndarray:
        """(n,) int; NOT_RECORDED between segments."""


class _OnSite:
    """A platform that turns about its origin at the origin of the world, recorded throughout."""

    continuous = True
    numbered = False
    duration_s: float

    def origin(self, t: Array) -> Array:
        return np.zeros((len(t), 3))

    def segment(self, t: Array) -> np.ndarray:
        return np.zeros(len(t), dtype=np.int64)

    @property
    def _span(self) -> tuple[float, float]:
        return (-MARGIN_S, self.duration_s + MARGIN_S)


class Tumbling(_OnSite):
    """q' = q omega / 2 for a smooth random body rate, by fourth-order Magnus steps.

    The last step, from a knot to the time asked, is integrated too, so that the attitude has no interpolation in it.
    """

    def __init__(self, spec: TumblingSpec, rng: np.random.Generator) -> None:
        self.duration_s = spec.duration_s
        rms = np.deg2rad(spec.rate_rms_deg_s)
        self.step = min(spec.rate_time_s / 20, 0.05 / rms)
        self.rate = SmoothRandom(rng, (self._span[0] - 1, self._span[1] + 1), spec.rate_time_s, rms, 3)
        first = uniform_attitudes(rng, 1)
        begins = self._span[0] + self.step * np.arange(int(np.ceil((self._span[1] - self._span[0]) / self.step)) + 1)
        turns = exponential(self._turn(begins, np.full(len(begins), self.step)))
        self.knots = cumulative(np.concatenate([first, turns]))

    def _turn(self, begin: Array, length: Array) -> Array:
        """Rotation vector (n, 3) over [begin, begin + length]: Magnus expansion on two Gauss points."""
        one = self.rate(begin + (0.5 - np.sqrt(3) / 6) * length)
        two = self.rate(begin + (0.5 + np.sqrt(3) / 6) * length)
        bend = np.stack(
            [one[:, (i + 1) % 3] * two[:, (i + 2) % 3] - one[:, (i + 2) % 3] * two[:, (i + 1) % 3] for i in range(3)],
            axis=-1,
        )
        out: Array = (one + two) * (length / 2)[:, None] + bend * (np.sqrt(3) / 12 * length**2)[:, None]
        return out

    def attitude(self, t: Array) -> Array:
        k = np.floor((t - self._span[0]) / self.step).astype(int)
        begin = self._span[0] + k * self.step
        return normalised(multiply(self.knots[k], exponential(self._turn(begin, t - begin))))


def _about(axis: str, angle: Array) -> Array:
    """Quaternions (n, 4) of active rotations about a frame axis by angles (n,) rad."""
    vector = np.zeros((len(angle), 3))
    vector[:, "xyz".index(axis)] = angle
    return exponential(vector)


def _heading(yaw: Array, pitch: Array, roll: Array) -> Array:
    """Platform-to-world quaternions Rz(yaw) Ry(pitch) Rx(roll), angles (n,) rad."""
    return multiply(multiply(_about("z", yaw), _about("y", pitch)), _about("x", roll))


class LimitedTilt(_OnSite):
    """Roll and pitch are the limit times the sine of a wandering phase: smooth, and often near the limit."""

    PHASE_RMS = 3.0

    def __init__(self, spec: LimitedTiltSpec, rng: np.random.Generator) -> None:
        self.duration_s = spec.duration_s
        self.limit = np.deg2rad(spec.tilt_deg)
        self.phase = SmoothRandom(rng, self._span, spec.tilt_time_s, self.PHASE_RMS, 2)
        yaw_rms = np.deg2rad(spec.yaw_rate_rms_deg_s) * spec.yaw_time_s * np.sqrt(SPLINE_POWER / SPLINE_SLOPE_POWER)
        self.yaw = SmoothRandom(rng, self._span, spec.yaw_time_s, yaw_rms, 1)

    def attitude(self, t: Array) -> Array:
        tilt = self.limit * np.sin(self.phase(t))
        return _heading(self.yaw(t)[:, 0], tilt[:, 1], tilt[:, 0])


class OneAxis(_OnSite):
    """A steady turn about one axis."""

    def __init__(self, spec: OneAxisSpec, rng: np.random.Generator) -> None:
        self.duration_s = spec.duration_s
        self.rate = np.deg2rad(spec.rate_deg_s) * np.array(spec.axis) / np.linalg.norm(spec.axis)
        self.first = exponential(np.deg2rad(np.array(spec.tilt_deg)))

    def attitude(self, t: Array) -> Array:
        return multiply(self.first[None], exponential(t[:, None] * self.rate))


def _smooth_step(u: Array) -> Array:
    """0 below 0, 1 above 1, twice continuously differentiable between."""
    u = np.clip(u, 0.0, 1.0)
    out: Array = u**3 * (10 + u * (6 * u - 15))
    return out


class Postures(_OnSite):
    """Rest, turn, rest, ...: the turn follows the shortest way with zero rate and acceleration at both ends."""

    numbered = True

    def __init__(self, spec: PosturesSpec, rng: np.random.Generator) -> None:
        turntable = _about("z", 2 * np.pi * np.arange(spec.turntable_steps) / max(spec.turntable_steps, 1))
        self.attitudes = np.concatenate([turntable, _random_tilts(rng, spec.random_count, spec.tilt_deg)])
        self.rest_s, self.period_s = spec.rest_s, spec.rest_s + spec.turn_s
        self.duration_s = spec.duration_s
        following = np.roll(self.attitudes, -1, axis=0)
        self.turns = logarithm(multiply(conjugate(self.attitudes), following))

    def attitude(self, t: Array) -> Array:
        k = np.clip(np.floor(t / self.period_s).astype(int), 0, len(self.attitudes) - 1)
        done = _smooth_step((t - k * self.period_s - self.rest_s) / (self.period_s - self.rest_s))
        return normalised(multiply(self.attitudes[k], exponential(self.turns[k] * done[:, None])))

    def segment(self, t: Array) -> np.ndarray:
        # The 1e-9 s keep a sample at the very begin of a rest, which rounding may put before it.
        k = np.floor((t + 1e-9) / self.period_s).astype(np.int64)
        resting = (t + 1e-9 - k * self.period_s < self.rest_s) & (k >= 0) & (k < len(self.attitudes))
        return np.where(resting, k, NOT_RECORDED)


def _random_tilts(rng: np.random.Generator, count: int, tilt_deg: float | None) -> Array:
    """Uniform attitudes whose z axis leans from up by at most the limit."""
    if tilt_deg is None or tilt_deg >= 180:
        return uniform_attitudes(rng, count)
    lean = np.arccos(rng.uniform(np.cos(np.deg2rad(tilt_deg)), 1.0, count))
    towards, yaw = rng.uniform(0, 2 * np.pi, (2, count))
    axis = np.stack([-np.sin(towards), np.cos(towards), np.zeros(count)], axis=-1)
    return multiply(exponential(axis * lean[:, None]), _about("z", yaw))


class Attitudes(_OnSite):
    """A list of attitudes, one sample each."""

    continuous = False

    def __init__(self, attitudes: Array, rate_Hz: float) -> None:
        self.attitudes, self.rate_Hz = attitudes, rate_Hz
        self.duration_s = len(attitudes) / rate_Hz

    def attitude(self, t: Array) -> Array:
        return self.attitudes[np.clip(np.rint(t * self.rate_Hz).astype(int), 0, len(self.attitudes) - 1)]


def _from_angles(angles: Array, sequence: str, zero_frame: str) -> Array:
    """Attitudes (n, 4) from angles (3, n) rad about x, y, z: b_platform = R1 R2 R3 b_zero with passive matrices."""
    world_to_platform = np.broadcast_to(ENU_TO_NED if zero_frame == "NED" else np.eye(3), (angles.shape[1], 3, 3))
    for axis in reversed(sequence):
        world_to_platform = passive(axis, angles["xyz".index(axis)]) @ world_to_platform
    return quaternions(np.swapaxes(world_to_platform, -1, -2))


class SurveyLines:
    """Boustrophedon lines; while turning, the path blends from the prolongation of one line to that of the next."""

    continuous = True
    numbered = True

    def __init__(self, spec: SurveyLinesSpec, rng: np.random.Generator) -> None:
        self.spec = spec
        self.line_s = spec.length_m / spec.speed_m_s
        self.period_s = self.line_s + spec.turn_s
        self.duration_s = spec.duration_s
        span = (-MARGIN_S, self.duration_s + MARGIN_S)
        self.wobble = SmoothRandom(rng, span, spec.wobble_time_s, np.deg2rad(spec.wobble_deg), 3)
        azimuth = np.deg2rad(spec.azimuth_deg)
        self.along = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
        self.across = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
        self.yaw = np.pi / 2 - azimuth

    def _line(self, t: Array) -> tuple[np.ndarray, Array]:
        """Number of the line last begun, and how much of the turn after it is done (0 to 1, smooth)."""
        k = np.clip(np.floor((t + 1e-9) / self.period_s).astype(np.int64), 0, self.spec.lines - 1)
        return k, _smooth_step((t - k * self.period_s - self.line_s) / self.spec.turn_s)

    def _prolonged(self, k: np.ndarray, t: Array) -> Array:
        run = self.spec.speed_m_s * (t - k * self.period_s)
        forward = np.where(k % 2 == 0, run, self.spec.length_m - run)
        start = np.array(self.spec.start_m) + np.array([0.0, 0.0, self.spec.height_m])
        out: Array = start + forward[:, None] * self.along + (k * self.spec.spacing_m)[:, None] * self.across
        return out

    def origin(self, t: Array) -> Array:
        k, done = self._line(t)
        turning = np.where(k + 1 < self.spec.lines, done, 0.0)[:, None]
        return (1 - turning) * self._prolonged(k, t) + turning * self._prolonged(k + 1, t)

    def attitude(self, t: Array) -> Array:
        k, done = self._line(t)
        roll, pitch, yaw = self.wobble(t).T
        half_turns = k + done if self.spec.turn_round else np.zeros(len(t))
        return _heading(self.yaw + np.pi * half_turns + yaw, pitch, roll)

    def segment(self, t: Array) -> np.ndarray:
        k, _ = self._line(t)
        return np.where(t + 1e-9 - k * self.period_s < self.line_s, k, NOT_RECORDED)


def build_motion(spec: MotionSpec, rng: np.random.Generator, rate_Hz: float) -> Motion:
    """The motion a scenario describes."""
    if isinstance(spec, TumblingSpec):
        return Tumbling(spec, rng)
    if isinstance(spec, LimitedTiltSpec):
        return LimitedTilt(spec, rng)
    if isinstance(spec, PosturesSpec):
        return Postures(spec, rng)
    if isinstance(spec, OneAxisSpec):
        return OneAxis(spec, rng)
    if isinstance(spec, SurveyLinesSpec):
        return SurveyLines(spec, rng)
    if isinstance(spec, EulerGridSpec):
        steps = np.deg2rad(np.arange(0.0, 360.0 - 1e-9, spec.step_deg))
        angles = np.stack([a.ravel() for a in np.meshgrid(steps, steps, steps, indexing="ij")])
        return Attitudes(_from_angles(angles, spec.sequence, spec.zero_frame), rate_Hz)
    if spec.euler_limits_deg is None:
        return Attitudes(uniform_attitudes(rng, spec.count), rate_Hz)
    angles = rng.uniform(-1, 1, (3, spec.count)) * np.deg2rad(np.array(spec.euler_limits_deg))[:, None]
    return Attitudes(_from_angles(angles, spec.sequence, spec.zero_frame), rate_Hz)


def angular_rate(motion: Motion, t: Array, half_step_s: float = 1e-4) -> Array:
    """(n, 3) rad/s in the platform frame, from the attitudes just before and just after."""
    turn = multiply(conjugate(motion.attitude(t - half_step_s)), motion.attitude(t + half_step_s))
    return logarithm(turn) / (2 * half_step_s)


def specific_force(motion: Motion, t: Array, step_s: float = 1e-2, gravity_m_s2: float = 9.81) -> Array:
    """(n, 3) m/s^2 in the platform frame: what an accelerometer at the platform origin reads; +g up at rest."""
    acceleration = (motion.origin(t - step_s) - 2 * motion.origin(t) + motion.origin(t + step_s)) / step_s**2
    return transform_back(matrices(motion.attitude(t)), acceleration + np.array([0.0, 0.0, gravity_m_s2]))
