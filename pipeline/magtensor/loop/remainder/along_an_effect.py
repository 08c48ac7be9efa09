"""Whether what is left of a sensor lies along the vector that an adopted effect has there: then its law leaves it.

Noise of a sensor is on all of its axes, or on one of them; the vector of an effect is any. So what goes slowly along
that vector and along no other is the effect itself, by another law than the model's: a play, a product, what happens
whenever its cause changes.
"""

from __future__ import annotations

import numpy as np

from magtensor.calibration.types import Array
from magtensor.loop.evidence.by_blocks import BLOCKS, least_t, means_of, t_of
from magtensor.loop.fitting.model import State
from magtensor.loop.fitting.separation import SECOND_ORDER

MEANS = 8  # samples taken together: noise of a log, which is white, is not in how these follow each other
ALPHA = 0.001  # for all effects and sensors together
ONE_VECTOR = 0.95  # of the square of what an effect adds to a sensor, and of what goes slowly there


def along_an_effect_words(state: State) -> list[str]:
    """The sensor of whose rest most lies along the vector of an adopted effect, by how much; nothing where none does,
    and of single sensors, whose axes do not show.

    Two axes or more have to share in the vector: noise of one alone would lie along another effect's by chance.
    """
    residual, sensors = state.residual, state.excitation.sensors
    if residual.across is None or len(residual.across) < 2 * BLOCKS * MEANS:
        return []
    seen, found = np.diagonal(residual.projector).reshape(-1, 3).mean(axis=1), (0.0, "", "")
    least = least_t(ALPHA / max(len(state.adopted) * len(sensors), 1))
    for model, theta in zip(state.adopted, state.theta, strict=True):
        terms = model.terms(state.excitation)
        if terms.delay is not None:
            continue
        added = (
            terms.at(residual.samples).contribution(theta, len(residual.noise)) / residual.noise @ residual.projector
        )
        for number, name in enumerate(sensors):
            part = slice(3 * number, 3 * number + 3)
            along = _along(residual.across[:, part], added[:, part], least)
            if along is None:
                continue
            vector, power = along
            amount = np.sqrt(power) / seen[number] * float(np.linalg.norm(vector * residual.noise[part]))
            found = max(found, (amount, name, model.name))
    amount, name, effect = found
    lies = f"what is left of {name} lies along the vector that {effect} has there, as what its law leaves"
    return [f"{lies}: {amount:.3g} nT rms"] if effect else []


def _along(left: Array, added: Array, least: float) -> tuple[Array, float] | None:
    """The unit vector along which an effect adds to a sensor (N, 3), and the mean square of what is left (N, 3) that
    goes slowly along it; None where that goes along others too, or its t over blocks is below the least."""
    own = added - added.mean(axis=0)
    _, size, directions = np.linalg.svd(own, full_matrices=False)
    if size[0] == 0.0 or size[0] ** 2 < ONE_VECTOR * np.sum(size**2):
        return None
    vector = directions[0]
    if np.max(vector**2) > ONE_VECTOR:  # an axis, which may have noise of its own
        return None
    count = len(left) // MEANS * MEANS
    means = left[:count].reshape(-1, MEANS, 3).mean(axis=1)
    follow = np.einsum("ni,nj->nij", means[:-1], means[1:])
    strengths = np.linalg.eigvalsh(0.5 * (follow.mean(axis=0) + follow.mean(axis=0).T))
    each = means_of(vector @ follow @ vector)
    power = float(each.mean())
    if t_of(each) < least:
        return None
    if power < ONE_VECTOR * float(np.abs(strengths).sum()) or power < SECOND_ORDER * float(np.mean(own**2) * 3.0):
        return None
    return vector, power
