"""The depth camera: what it sees of the ground and of the robot's own links, and when."""

from cref_jax.depth.camera import is_due, longest_hold, max_frames, min_filter, normalize, pose
from cref_jax.depth.image import capsules_in_view, locate_pixels, render, render_capsules

__all__ = [
    "capsules_in_view",
    "is_due",
    "locate_pixels",
    "longest_hold",
    "max_frames",
    "min_filter",
    "normalize",
    "pose",
    "render",
    "render_capsules",
]
