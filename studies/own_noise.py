"""How often noise of the sensors has a small p value in noise of their own spectra, whatever its law.

    python studies/own_noise.py --page docs/own_noise.md

Surveys without any effect, simulated as for loop_power.md (four sensors with 0.15 nT of white noise each axis and 1/f
noise, half an hour), to whose outputs more noise is added, and series that nobody sought in them: jumps of the offsets
at ten random times, two warmings up and the temperature. Of each the p value (`loop/evidence/own_noise.py`) of its
twelve offsets is asked: by the score alone, and as the loop has it, with the exact law of one series beside it. Where
the noise is stationary as few as the level says should be below it. The tests of one survey share its noise, so
that a share is known less well than its number of tests suggests.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import h5py
import numpy as np
from loop_surveys import recorded, scenario
from scipy.signal import lfilter

from magtensor.calibration.types import Array
from magtensor.error_models.terms import Terms
from magtensor.loop.evidence.own_noise import OwnNoise
from magtensor.loop.fitting.model import Fitting, State
from magtensor.loop.fitting.refit import joint_state
from magtensor.registry import Registry
from magtensor.simulate import simulate

LEVELS = (0.1, 0.01, 0.001, 0.0001)
WALK = 0.3  # nT that a walk has gone at the survey's end, rms
FIRST_SEED = 7000
JUMPS = 10


def walk(rng: np.random.Generator, samples: int, axes: int) -> Array:
    """(N, axes) nT, a random walk each."""
    return np.asarray(WALK / np.sqrt(samples) * np.cumsum(rng.standard_normal((samples, axes)), axis=0))


def lagging(rng: np.random.Generator, samples: int, axes: int, lag: float = 100.0) -> Array:
    """(N, axes) nT, white noise through a lag of so many samples, 0.3 nT rms."""
    keep = np.exp(-1.0 / lag)
    out = lfilter([1.0], [1.0, -keep], rng.standard_normal((samples + round(10 * lag), axes)), axis=0)[-samples:]
    return np.asarray(0.3 * out * np.sqrt(1.0 - keep**2))


def of_one(make: Callable[..., Array], rng: np.random.Generator, samples: int) -> Array:
    """(N, 4, 3) nT in the second sensor alone."""
    return np.stack([make(rng, samples, 3) * (s == 1) for s in range(4)], axis=1)


def of_all(make: Callable[..., Array], rng: np.random.Generator, samples: int) -> Array:
    """(N, 4, 3) nT, each axis its own."""
    return make(rng, samples, 12).reshape(samples, 4, 3)


def ending(rng: np.random.Generator, samples: int) -> Array:
    """(N, 4, 3) nT in all, in the first third only."""
    return of_all(lagging, rng, samples) * (np.arange(samples) < samples // 3)[:, None, None]


NOISES: dict[str, Callable[[np.random.Generator, int], Array]] = {
    "nothing more": lambda rng, samples: np.zeros((samples, 4, 3)),
    "all sensors walk": partial(of_all, walk),
    "one sensor walks": partial(of_one, walk),
    "all sensors lag behind white noise by 50 s": partial(of_all, lagging),
    "one sensor does": partial(of_one, lagging),
    "all sensors do, in the first third only": ending,
}


def series(state: State, rng: np.random.Generator) -> Iterator[Terms]:
    """What is asked of a survey."""
    registry, x = Registry.load(), state.excitation
    asked = [("warm_up", {"tau_s": 30.0}), ("warm_up", {"tau_s": 300.0})]
    asked += [("temperature_offset", {"channel": "temperature", "lag_s": 100.0})]  # type: ignore[dict-item]
    asked += [("offset_step", {"time_s": t}) for t in rng.uniform(0.05, 0.95, JUMPS) * x.duration]
    for name, settings in asked:
        yield registry.find("error_model", name).function(x, **settings).at(state.residual.samples)


def p_values(kind: str, motion: str, seed: int) -> list[tuple[float, float]]:
    """By the score alone and as the loop has it, of each series."""
    rng = np.random.default_rng(seed)

    def add(path: Path) -> None:
        with h5py.File(path, "a") as file:
            file["b_raw"][:] = file["b_raw"][:] + NOISES[kind](rng, len(file["time"]))

    state = joint_state(recorded(simulate(scenario(motion, 0.02, seed)), add), [], Fitting())
    noise = OwnNoise(state.residual, None)
    return [(noise.by_score(terms), noise.p_value(terms)) for terms in series(state, rng)]


def main() -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", type=Path, help="write the table here")
    parser.add_argument("--surveys", type=int, default=20, help="of each kind and motion")
    chosen = parser.parse_args()
    levels = " | ".join(f"p < {level:g}" for level in LEVELS)
    lines = [f"| noise added | motion | tests | {levels} |", "|---|---|---|" + "---|" * len(LEVELS)]
    for kind in NOISES:
        for motion in ("tumbling", "postures"):
            seeds = range(FIRST_SEED, FIRST_SEED + chosen.surveys)
            p = np.array([both for seed in seeds for both in p_values(kind, motion, seed)])
            shares = (f"{100 * b:.2g} % ({100 * a:.2g} %)" for a, b in (np.mean(p < level, axis=0) for level in LEVELS))
            lines.append(f"| {kind} | {motion} | {len(p)} | {' | '.join(shares)} |")
            print(lines[-1], flush=True)
    if chosen.page:
        words = (__doc__ or "").split("\n\n", 2)[2]
        command = f"`python studies/own_noise.py {' '.join(sys.argv[1:])}`; in brackets by the score alone"
        chosen.page.write_text("\n".join(["# Noise in noise of its own spectrum", "", words, command, "", *lines, ""]))


if __name__ == "__main__":
    main()
