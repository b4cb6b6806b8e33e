"""Evaluations made up by hand: every number differs from its neighbours."""

import copy
from typing import Any

LEVELS = ("easy", "medium", "hard", "ood")
SIZES = {
    "stairs": (0.10, 0.15, 0.20, 0.23),
    "gap": (0.30, 0.50, 0.75, 0.80),
    "platform": (0.20, 0.30, 0.40, 0.43),
}
PAPER = {  # Table II of the paper
    "stairs": (0.9985, 0.9975, 0.9725, 0.7345),
    "gap": (0.9930, 0.9835, 0.9215, 0.4470),
    "platform": (0.9965, 0.9935, 0.9735, 0.8435),
}
HEAD = {
    "seed": 7,
    "device": "1 x cpu",
    "cores": 4,
    "versions": {"cref-jax": "0.1.0", "jax": "0.10.2"},
    "seconds": 412.3,
    "rule": "a trial fails if the robot falls, stalls for 10 s, or takes more than 40 s",
    "a key of another version": [1, {"deep": None}],
}


def cell(kind: str, number: int, policies: int) -> dict[str, Any]:
    """Return a cell; harder ones fail more."""
    row = list(SIZES).index(kind)
    trials, failed = 200, 3 + 17 * number**2 + 5 * row
    up = failed // 3 if kind == "stairs" else None
    rate = (trials - failed) / trials
    causes = ("tilted", "low", "hit", "dropped", "unstable", "stalled", "late")
    parts = [failed // 4, failed // 5, 1, 0, 0, failed // 3]
    paper = PAPER[kind][number]
    speeds = [48, 51, 49, 52]
    return {
        "kind": kind,
        "level": LEVELS[number],
        "size_m": SIZES[kind][number],
        "trials": trials,
        "successes": trials - failed,
        "rate": rate,
        "wilson_low": rate - 0.031 - 0.001 * row,
        "wilson_high": min(1.0, rate + 0.027),
        "up_failures": up,
        "down_failures": None if up is None else failed - up,
        "failures": dict(zip(causes, [*parts, failed - sum(parts)], strict=True)),
        "by_speed": [
            {
                "low": 0.4 + 0.1 * k,
                "high": 0.5 + 0.1 * k,
                "trials": n,
                "successes": n - (failed + k) // 4,
            }
            for k, n in enumerate(speeds)
        ],
        "sideways": {"drift_m": 0.11, "largest_m": 0.22 + 0.01 * number, "worst_m": 0.57},
        "by_policy": [rate + 0.013 * (k - (policies - 1) / 2) for k in range(policies)],
        "spread": None if policies == 1 else 0.013,
        "paper": {
            "rate": paper,
            "trials": 2000,
            "difference": rate - paper,
            "significant": number > 0,
        },
    }


def table(policies: int = 1) -> dict[str, Any]:
    """Return an evaluation of the suite table."""
    return {
        "suite": "table",
        **copy.deepcopy(HEAD),
        "policies": [
            {
                "name": f"seed{k}",
                "source": f"runs/mixed-{k}",
                "digest": f"{k:x}" * 64,
                "iteration": 2800 + k,
                "samples": 17203200 + k,
            }
            for k in range(policies)
        ],
        "cells": [cell(kind, number, policies) for kind in SIZES for number in range(4)],
        "overall": {
            "rate": 0.613,
            "wilson_low": 0.592,
            "wilson_high": 0.634,
            "paper": 0.9046,
            "trained": 0.704,
            "paper_trained": 0.9811,
            "ood": 0.305,
            "paper_ood": 0.675,
        },
    }


def ood() -> dict[str, Any]:
    """Return an evaluation of the suite ood."""
    scenes = [
        {
            "name": f"pallets_{k}",
            "title": f"Pallets with slots of {k + 2} cm",
            "trials": 40,
            "successes": 39 - 5 * k,
            "rate": (39 - 5 * k) / 40,
            "wilson_low": (39 - 5 * k) / 40 - 0.11,
            "wilson_high": min(1.0, (39 - 5 * k) / 40 + 0.09),
            "failures": {"tilted": 1 + 3 * k, "stalled": 2 * k},
            "sideways": {"drift_m": 0.13, "largest_m": 0.31 + 0.01 * k, "worst_m": 0.68},
        }
        for k in range(6)
    ]
    conditions = [
        {
            "name": "frames dropped",
            "value": f"{share} %",
            "trials": 80,
            "successes": 71 - share,
            "passed": 5 - share // 20,
        }
        for share in (0, 10, 30, 50)
    ]
    return {
        "suite": "ood",
        **copy.deepcopy(HEAD),
        "policies": table()["policies"],
        "scenes": scenes,
        "passed": 4,
        "conditions": conditions,
    }


WALK = {
    "suite": "walk",
    "run": "runs/flat",
    "iteration": 860,
    "seed": 0,
    "episodes": 200,
    "fell": 3,
    "by_cause": {"tilted": 2, "low": 1, "hit": 0},
    "speed_error": 0.0936189,
    "tracking_error": 0.118267,
    "airborne": [0.342862, 0.312355],
    "step_seconds": 0.244458,
    "sideways": {"drift_m": 0.141, "largest_m": 0.262, "worst_m": 0.383},
}
COMMANDS = {
    "suite": "commands",
    "seed": 0,
    "commands": [
        {
            "command": [0.0, 0.0, 0.0],
            "trials": 40,
            "fell": 1,
            "velocity": [0.012, -0.003, 0.021],
            "error": [0.014, 0.015, 0.022],
            "airborne": [0.16, 0.17],
            "stood": 33,
            "still": 29,
            "drift_m": 0.03,
        },
        {
            "command": [0.6, 0.0, 0.0],
            "trials": 40,
            "fell": 40,
            "velocity": None,
            "error": None,
            "airborne": None,
        },
    ],
    "stop": {"trials": 40, "fell": 2, "distance_m": 0.418},
}
CROSS = {
    "suite": "cross",
    "run": "runs/gap",
    "iteration": 2800,
    "seed": 0,
    "kind": "gap",
    "size_m": 0.3,
    "trials": 200,
    "successes": 191,
    "by_cause": {"tilted": 3, "low": 6, "timeout": 0},
    "seconds": 20.0977,
}
