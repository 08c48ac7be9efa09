"""How many samples a cosine transform is quick with: of a length that has a large prime factor it takes two to eight
times as long."""

from __future__ import annotations

LONG = 1000  # samples, from which on a transform of an awkward length takes long
LARGEST_FACTOR = 23  # of a length that is not awkward


def quick_length(count: int) -> int:
    """The longest that is not awkward, of so many samples at most: 0.1 % fewer in the mean, 1.3 % at most."""
    while count > LONG and _rough(count) > 1:
        count -= 1
    return count


def _rough(number: int) -> int:
    """What is left of a number without its factors up to `LARGEST_FACTOR`."""
    for factor in range(2, LARGEST_FACTOR + 1):
        while number % factor == 0:
            number //= factor
    return number
