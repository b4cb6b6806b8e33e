"""How sure a share of successes is."""

import math


def wilson(successes: int, trials: int, z: float = 1.96) -> tuple[float, float]:
    """Return the lowest and the highest share that agree with what was counted.

    Wilson's score interval; with z = 1.96 it holds the true share in 95 of 100 experiments:

        (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)
    """
    if trials == 0:
        return 0.0, 1.0
    share, spread = successes / trials, z * z / trials
    middle = (share + 0.5 * spread) / (1.0 + spread)
    half = math.sqrt(spread * share * (1.0 - share) + 0.25 * spread * spread) / (1.0 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)
