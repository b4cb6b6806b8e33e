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
"""

from __future__ import annotations

import cref_jax.runtime.threads  # noqa: F401

import argparse
import sys

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
    "contents",
    "load",
    "manifest_digest",
    "report",
    "self_test",
]


def main() -> None:
    """Run the self-test from the command line; exit code 2 if it fails."""
    parser = argparse.ArgumentParser(description="Test an exported policy on this machine.")
    parser.add_argument("--selftest", metavar="DIRECTORY", required=True, help="or its .zip")
    path = parser.parse_args().selftest
    try:
        times = self_test(path)
    except PolicyFormatError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    print(f"{path}: outputs match the training network to {TOLERANCE:g}")
    print("\n".join(report(times)))


if __name__ == "__main__":
    main()
