"""The joints that a policy drives."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cref_jax.runtime.tables import PolicyFormatError, Table


class Joints(NamedTuple):
    """The joints driven by the policy, in the order of every array; SI units."""

    names: tuple[str, ...]
    default: np.ndarray  # rad, q0
    scale: np.ndarray  # rad per unit of action
    low: np.ndarray  # rad
    high: np.ndarray  # rad
    kp: np.ndarray  # N m/rad
    kd: np.ndarray  # N m s/rad
    effort: np.ndarray  # N m


def read_joints(root: Table) -> Joints:
    """Read the joints of the manifest."""
    tables = root.tables("joints")
    names = tuple(table.text("name") for table in tables)
    if not names or len(set(names)) < len(names):
        raise PolicyFormatError("manifest.joints must be one or more joints of different names")
    ranges = {
        "default_rad": (-10.0, 10.0),
        "action_scale_rad": (0.0, 10.0),
        "low_rad": (-10.0, 10.0),
        "high_rad": (-10.0, 10.0),
        "kp": (0.0, 1e4),
        "kd": (0.0, 1e3),
        "effort_nm": (0.0, 1e4),
    }
    columns = [
        np.array([table.real(key, low, high) for table in tables], np.float32)
        for key, (low, high) in ranges.items()
    ]
    joints = Joints(names, *columns)
    if not (joints.low < joints.high).all():
        raise PolicyFormatError("manifest.joints: low_rad must be below high_rad")
    return joints
