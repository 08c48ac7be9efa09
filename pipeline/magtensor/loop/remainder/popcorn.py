"""Noise of a sensor that stays at a level for a while and jumps to another one, as popcorn noise does.

Magnetoresistive sensors have it (random telegraph noise), converters, and contacts that open and close. No error model
follows it, and no law of steady noise makes it.
"""

from __future__ import annotations

import numpy as np

from magtensor.loop.evidence.jumps import jumpiness
from magtensor.loop.fitting.model import State

JUMPS = 5.0  # standard errors of the kurtosis: steady noise had less in all of some ten thousand series
SLOW = 1.0  # times the white noise: less is hardly told from heavy tails
MEANS = 8  # samples that are taken together to see what is slow


def popcorn_words(state: State) -> list[str]:
    """The sensor, of two both, what is left of which goes in jumps most, along one direction, and by how much; nothing
    where none does."""
    residual, x = state.residual, state.excitation
    sensors, run = x.sensors, x.run[residual.samples]
    if residual.across is None:
        return []
    most, words = 0.0, list[str]()
    seen = np.diagonal(residual.projector).reshape(-1, 3).mean(axis=1)
    for number, name in enumerate(sensors):
        own = residual.across[:, 3 * number : 3 * number + 3]
        count = len(own) // MEANS * MEANS
        slow = own[:count].reshape(-1, MEANS, 3).mean(axis=1)
        direction = np.linalg.svd(slow - slow.mean(axis=0), full_matrices=False)[2][0]
        along = own @ direction
        beyond = float(np.sqrt(max(np.mean(along**2) - seen[number], 0.0)))
        if beyond < max(most, SLOW * float(np.sqrt(seen[number]))) or jumpiness(along, run) < JUMPS:
            continue
        vector = direction * residual.noise[3 * number : 3 * number + 3]
        amount = beyond / seen[number] * float(np.linalg.norm(vector))
        most, where = beyond, " or ".join(sensors) if len(sensors) == 2 else name
        axes = ", ".join(f"{v:.2f}" for v in vector / np.linalg.norm(vector))
        words = [
            f"what is left of {where} goes in jumps, as popcorn noise of a sensor does or a contact that opens and "
            f"closes: {amount:.3g} nT rms along ({axes})"
        ]
    return words
