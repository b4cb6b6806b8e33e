"""Run a policy on a robot: one file that needs only Python 3.8 and numpy 1.20 or newer.

    policy = load("policy/", joints=names_in_the_robots_own_order)
    policy.reset()
    policy.on_depth(frame, stamp)  # for every camera frame; from any one thread
    target = policy.step(angular_velocity, gravity, command, q, qd, now)  # at 50 Hz

`load` raises PolicyFormatError unless the files are exactly a policy. After loading, no call
raises. Before the start the pose measured first is held until all inputs are right. After it, a
sense that disagrees with the others is done without and the robot stands; an impossible input
holds the last target for some steps, and then, until `reset`, the target is the measured pose, so
that PD only damps. `policy.status` and `policy.why` say what is wrong.

On a machine with only numpy: python cref_runtime.py --selftest policy/
`policy.recorder.write("last.npz")` keeps the last 30 s for --replay and --check. Before the first
walk, let the robot stand by its own controller in the default pose for five seconds, call `step`
and `on_depth` without sending the targets, write, and look at what --check finds odd.
"""

from __future__ import annotations

import cref_jax.runtime.threads  # noqa: F401

import argparse
import os
import sys

from cref_jax.runtime.check import check, replay
from cref_jax.runtime.files import SCHEMA, contents, manifest_digest
from cref_jax.runtime.joints import Joints
from cref_jax.runtime.network import VARIANTS
from cref_jax.runtime.policy import TERMS, Policy, load
from cref_jax.runtime.self_test import TOLERANCE, report, self_test
from cref_jax.runtime.status import FAULTS, Status
from cref_jax.runtime.tables import PolicyFormatError

__all__ = [
    "FAULTS",
    "SCHEMA",
    "TERMS",
    "TOLERANCE",
    "VARIANTS",
    "Joints",
    "Policy",
    "PolicyFormatError",
    "Status",
    "check",
    "contents",
    "load",
    "manifest_digest",
    "replay",
    "report",
    "self_test",
]


def main() -> None:
    """Run the command line; exit code 2 if something cannot be read, 1 if something is odd.

    It is 141, as of a program that SIGPIPE ends, where nobody reads the output to its end.
    """
    parser = argparse.ArgumentParser(description="An exported policy on this machine.")
    add, both = parser.add_mutually_exclusive_group(required=True).add_argument, ("FILE", "POLICY")
    add("--selftest", metavar="POLICY", help="compare with training; a directory or its .zip")
    add("--replay", nargs=2, metavar=both, help="when which status began in a recording")
    add("--check", nargs=2, metavar=both, help="what is odd of a robot that stood still for 5 s")
    asked = parser.parse_args()
    try:
        code = _run(asked)
        sys.stdout.flush()
        sys.exit(code)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # flushed once more at exit
        sys.exit(141)
    except PolicyFormatError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def _run(asked: argparse.Namespace) -> int:
    """Do what was asked; return the exit code."""
    if asked.selftest:
        times = self_test(asked.selftest)
        print(f"{asked.selftest}: outputs match the training network to {TOLERANCE:g}")
        print("\n".join(report(times)))
        return 0
    if asked.check:
        odd = check(asked.check[1], asked.check[0])
        print("\n".join(odd) if odd else "nothing is odd")
        return 1 if odd else 0
    lines, largest = replay(asked.replay[1], asked.replay[0])
    print("\n".join(lines) if lines else "no status but OK")
    print(f"largest difference of a target from the recorded one: {largest:.2g} rad")
    return 0


if __name__ == "__main__":
    main()
