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

__all__ = [
    "FRICTION",
    "MOVING",
    "Actuated",
    "Capsules",
    "Mount",
    "Robot",
    "Spheres",
    "add_force_sensors",
    "load",
    "moving",
    "solve_sparsely",
    "spec",
]
