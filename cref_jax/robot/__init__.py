"""The robot: its model, its names as data, and its kinematics."""

from cref_jax.robot.model import (
    FRICTION,
    MOVING,
    Actuated,
    Capsules,
    Mount,
    Robot,
    Spheres,
    add_force_sensors,
    load,
    moving,
    solve_sparsely,
    spec,
)
from cref_jax.robot.registry import fill_in

__all__ = [
    "FRICTION",
    "MOVING",
    "Actuated",
    "Capsules",
    "Mount",
    "Robot",
    "Spheres",
    "add_force_sensors",
    "fill_in",
    "load",
    "moving",
    "solve_sparsely",
    "spec",
]
