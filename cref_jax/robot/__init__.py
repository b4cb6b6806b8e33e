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
from cref_jax.robot.registry import ROBOTS, fill_in, name_robot

__all__ = [
    "FRICTION",
    "MOVING",
    "ROBOTS",
    "Actuated",
    "Capsules",
    "Mount",
    "Robot",
    "Spheres",
    "add_force_sensors",
    "fill_in",
    "load",
    "moving",
    "name_robot",
    "solve_sparsely",
    "spec",
]
