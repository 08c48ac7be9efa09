"""Inverted, swapped and turned sensor axes, in words.

A scalar calibration cannot see them: |b| is the same. Two sensors side by side can: the best orthogonal map
between their calibrated outputs then mirrors, or is a signed permutation of the axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import permutations, product

import numpy as np

from .types import Array

FLATTEST = 0.1  # volume of three unit vectors; of right angles 1, of axes that are wrong by 30 degrees 0.7
_NAMES = "xyz"


def nearest_permutation(rotation: Array) -> Array:
    """The signed permutation matrix (3, 3) nearest to an orthogonal matrix (3, 3), of either determinant."""
    likeness = np.einsum("kij,ij->k", _signed_permutations(), rotation)
    return _signed_permutations()[int(np.argmax(likeness > likeness.max() - 1e-9))]  # of equals the first


@cache
def _signed_permutations() -> Array:
    """(48, 3, 3), the identity first."""
    return np.array(
        [
            np.eye(3)[list(order)] * np.array(signs)[:, None]
            for order in permutations(range(3))
            for signs in product((1.0, -1.0), repeat=3)
        ]
    )


def describe_axes(rotation: Array, sensor: str, reference: str) -> str:
    """What is wrong with the axes of a sensor, or an empty string where nothing is.

    Parameters
    ----------
    rotation: (3, 3) orthogonal, proper or not, with b_reference = rotation @ b_sensor.
    sensor, reference: their names.

    Returns
    -------
    For a rotation within 45 deg of none the empty string; else words such as "the x axis of S3 is inverted
    against S1", "the x and y axes of S3 are swapped against S1" or "S3 is mounted turned against S1: ...".
    """
    nearest = nearest_permutation(rotation)
    if np.array_equal(nearest, np.eye(3)):
        return ""
    off = nearest - np.diag(np.diag(nearest))
    if np.linalg.det(nearest) < 0:
        inverted = [n for n, d in zip(_NAMES, np.diag(nearest), strict=True) if d < 0]
        if not off.any():
            plural = len(inverted) > 1
            return (
                f"the {_listed(inverted)} {'axes' if plural else 'axis'} of {sensor} "
                f"{'are' if plural else 'is'} inverted against {reference}"
            )
        moved = [n for n, row in zip(_NAMES, off, strict=True) if row.any()]
        if len(moved) == 2 and off.sum() == 2:
            extra = f" and its {inverted[0]} axis is inverted" if inverted else ""
            return f"the {_listed(moved)} axes of {sensor} are swapped against {reference}{extra}"
    turned = ", ".join(
        f"{_NAMES[int(np.argmax(np.abs(column)))]} along {'+' if column.sum() > 0 else '-'}{_NAMES[k]}"
        for k, column in enumerate(nearest)
    )
    kind = "left-handed" if np.linalg.det(nearest) < 0 else "mounted turned"
    return f"{sensor} is {kind} against {reference}: {turned} of {reference}"


def axis_faults(rotations: Array, reference: int, names: Sequence[str]) -> tuple[str, ...]:
    """Words for every sensor whose axes do not agree with the others'.

    Parameters
    ----------
    rotations: (S, 3, 3) orthogonal, b_reference = rotations[s] @ b_s; that of the reference is the identity.
    reference: its index.
    names: (S,) names of the sensors.

    Returns
    -------
    One sentence for each such sensor. Where the reference stands alone against an agreeing majority of the
    others, it is the one that is named.
    """
    nearest = np.array([nearest_permutation(r) for r in rotations])
    others = [k for k in range(len(names)) if k != reference]
    first = nearest[others[0]] if others else np.eye(3)
    alone = len(others) > 1 and all(np.array_equal(nearest[k], first) for k in others)
    if alone and not np.array_equal(first, np.eye(3)):
        return (describe_axes(rotations[others[0]].T, names[reference], "the other sensors"),)
    found = (describe_axes(rotations[k], names[k], names[reference]) for k in others)
    return tuple(words for words in found if words)


def mirrored_words(matrix: Array) -> tuple[str, ...]:
    """Words for every sensor that is mirrored against the majority, from corrections that lead to one frame.

    Which of two halves is the mirrored one cannot be told; then the first sensor is taken for right.

    Parameters
    ----------
    matrix: (S, 3, 3) corrections, of whatever handedness.
    """
    hands = np.sign(np.linalg.det(matrix))
    right = np.sign(hands.sum()) or hands[0]
    reference = int(np.flatnonzero(hands == right)[0])
    maps = _against(matrix, reference)
    maps[hands == right] = np.eye(3)
    return axis_faults(maps, reference, [f"sensor {s + 1}" for s in range(len(matrix))])


def flat_words(forward: Array) -> tuple[str, ...]:
    """Words for every sensor whose three axes lie nearly in a plane, as no instrument's do.

    Parameters
    ----------
    forward: (S, 3, 3) from one frame to the outputs, whose rows are the axes.
    """
    volume = np.abs(np.linalg.det(forward / np.linalg.norm(forward, axis=2, keepdims=True)))
    return tuple(
        f"the three axes of sensor {s + 1} lie nearly in a plane: they span {volume[s]:.2g} of what right angles would"
        for s in np.flatnonzero(volume < FLATTEST)
    )


def turned_words(matrix: Array) -> tuple[str, ...]:
    """Words for every sensor whose axes lie along others than the first's: not a fault, but worth knowing."""
    return axis_faults(_against(matrix, 0), 0, [f"sensor {s + 1}" for s in range(len(matrix))])


def _against(matrix: Array, reference: int) -> Array:
    """(S, 3, 3) orthogonal maps from each sensor's raw axes to the reference's."""
    u, _, vt = np.linalg.svd(matrix)
    rotation = u @ vt
    out: Array = rotation[reference].T @ rotation
    return out


def _listed(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
