"""The paper's published results (Sec. III), and the formulas of its derived values.

Success is in percent of `TRIALS` trials per cell; obstacle sizes are in terrains/*.toml.
"""

from collections.abc import Mapping
from typing import NamedTuple

SAMPLES = 20_000 * 4096 * 24  # of training: iterations, robots (Sec. II-D), horizon (assumed)
TRIALS = 2000  # per cell; half of those on stairs go up, half down
KINDS = ("stairs", "gap", "platform")
LEVELS = ("easy", "medium", "hard", "ood")  # the last is outside the training range
ROUNDING = 0.01  # percentage points; a larger difference is not due to rounding

Cell = tuple[str, str]  # kind, level


class Method(NamedTuple):
    """A row of Tables II and III."""

    success: dict[Cell, float]  # %, Table II
    up: dict[str, int]  # failures going up, by level, Table III
    down: dict[str, int]  # failures going down, by level, Table III
    scenes: int  # of 20 in MuJoCo, Table II
    overall: float  # %, as printed in Table II


def _method(
    success: tuple[float, ...], failures: tuple[int, ...], scenes: int, overall: float
) -> Method:
    cells = [(kind, level) for kind in KINDS for level in LEVELS]
    return Method(
        success=dict(zip(cells, success, strict=True)),
        up=dict(zip(LEVELS, failures[0::2], strict=True)),
        down=dict(zip(LEVELS, failures[1::2], strict=True)),
        scenes=scenes,
        overall=overall,
    )


FULL = "Full CReF"
METHODS = {
    FULL: _method(
        (99.85, 99.75, 97.25, 73.45, 99.30, 98.35, 92.15, 44.70, 99.65, 99.35, 97.35, 84.35),
        (1, 2, 2, 3, 3, 52, 93, 438), 20, 90.45,
    ),
    "w/o Cross-Attn": _method(
        (96.25, 87.50, 78.70, 34.00, 97.10, 97.70, 83.00, 8.60, 99.40, 98.75, 96.90, 64.80),
        (0, 75, 47, 203, 88, 338, 496, 824), 19, 78.56,
    ),
    "w/o GRF": _method(
        (99.60, 93.40, 83.60, 49.10, 98.00, 98.25, 90.05, 29.95, 99.45, 99.15, 96.20, 68.55),
        (2, 6, 25, 107, 39, 289, 128, 890), 19, 83.78,
    ),
    "w/o Highway Gate": _method(
        (97.65, 98.40, 93.65, 50.20, 98.50, 96.90, 86.35, 17.20, 98.45, 97.65, 91.45, 73.10),
        (13, 34, 3, 29, 39, 88, 293, 703), 20, 83.29,
    ),
    "HPL": _method(
        (95.45, 81.45, 71.05, 27.40, 97.45, 94.40, 78.25, 20.85, 98.05, 92.65, 81.80, 55.15),
        (29, 62, 136, 235, 241, 338, 493, 959), 1, 74.57,
    ),
}  # fmt: skip
VARIANTS = {  # name here: row of Tables II and III
    "full": FULL,
    "no_cross_attention": "w/o Cross-Attn",
    "no_grf": "w/o GRF",
    "no_highway": "w/o Highway Gate",
    "hpl": "HPL",
}
DESCENT_MAD = {"full": 0.014, "foot_contact_quality": 0.028, "no_foothold_reward": 0.098}
"""m, median absolute deviation of touchdowns going down hard stairs, Sec. III-B"""


def overall(success: Mapping[Cell, float]) -> float:
    """Compute the unweighted mean of the twelve cells, including those outside training."""
    return sum(success[kind, level] for kind in KINDS for level in LEVELS) / 12.0


def stair_success(up: int, down: int, trials: int = TRIALS) -> float:
    """Compute the success on stairs, %, from the failures going up and going down."""
    return 100.0 * (1.0 - (up + down) / trials)


def find_misprints() -> dict[str, tuple[float, float]]:
    """Find derived values that differ from those printed: (printed, recomputed), %."""
    misprints = {}
    for name, method in METHODS.items():
        derived = {f"{name}, overall": (method.overall, overall(method.success))}
        for level in LEVELS:
            derived[f"{name}, stairs, {level}"] = (
                method.success["stairs", level],
                stair_success(method.up[level], method.down[level]),
            )
        wrong = lambda pair: abs(pair[0] - pair[1]) > ROUNDING
        misprints |= {title: pair for title, pair in derived.items() if wrong(pair)}
    return misprints
