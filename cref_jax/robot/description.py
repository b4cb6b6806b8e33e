"""A robot as data beside its MJCF: names, pose and roles.

Conventions of the MJCF, checked by `model.spec` and named in one line where they are not kept:

- One free body comes first, the base; every other joint is a hinge about its body's origin.
- Names of parts on both sides begin with `left_` and `right_`; the right one is the mirror image.
- Joints come in the order legs, waist, all others, and actuators in that of the joints.
- A joint has a range, its speed limit in rad/s as the first value of `user`, and a position
  actuator with kp, kv and a force range alone.
- Nothing collides by itself, and there are no sensors, keyframes, pairs, equalities or tendons.
- Spheres, and nothing else, touch the ground; their names begin with the names in `soles` for the
  feet. Capsules are the shapes of links, for depth and for noticing a fall.
- The sites of `camera` and `imu` exist, x forward and z up in the nominal pose.
"""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Description:
    """A robot as data. Joints are named by their kind, without side and `_joint`."""

    title: str
    """As people call it."""
    xml: Path
    """The MJCF, from primitives alone."""
    nominal_pose: dict[str, float]
    """rad, q_0 of both sides by kind of joint; turns about x and z are mirrored on the right. 0 for
    kinds that are not named."""
    hands: tuple[str, str]
    """Outermost bodies of the left and the right arm, which a rail may catch."""
    legs: tuple[str, ...]
    """What the names of leg joints hold after their side, such as `hip`."""
    waist: tuple[str, ...]
    """What the names of waist joints begin with."""
    base: str
    """The free body."""
    trunk: str
    """A geom of the torso: the body that bears it has the payload."""
    feet: tuple[str, str]
    """Bodies of the left and the right foot, whose origin is the ankle of Table I."""
    soles: tuple[str, str]
    """Beginnings of the names of the spheres under the left and the right foot."""
    hip_xz: tuple[str, ...]
    """Joints of Table I, hip position."""
    ankle_x: tuple[str, ...]
    """Joints of Table I, ankle position."""
    in_view: tuple[str, ...]
    """Links that may appear before the camera."""
    kept_clear: tuple[str, ...]
    """Links that touch the ground only when the robot has fallen."""
    base_height: float
    """m, the base above the soles in the nominal pose."""
    base_above_ankles: float
    """m, the same above the ankles (Table I)."""
    fallen_below: float
    """m, the base above the supporting ankles: lower, and the robot has fallen."""
    feet_apart: float
    """m, from ankle to ankle (Table I)."""
    sole_x: tuple[float, float, int]
    """m from, m to, samples along the sole, from the ankle (foot contact quality)."""
    sole_y: tuple[float, float, int]
    """m from, m to, samples across the sole, from the ankle (foot contact quality)."""
    camera_pitch: float
    """deg, the depth camera's optical axis below the x axis of its site."""
    camera: str = "depth_camera"
    """Site of the depth camera."""
    imu: str = "imu"
    """Site of the inertial sensor."""

    def nominal_angle(self, joint: str) -> float:
        """Return q_0 of a joint by its name, rad."""
        side, _, kind = joint.removesuffix("_joint").partition("_")
        mirrored = side == "right" and kind.endswith(("roll", "yaw"))
        angle = self.nominal_pose.get(kind, 0.0)
        return -angle if mirrored and angle else angle

    def is_leg(self, joint: str) -> bool:
        """Return whether a joint belongs to a leg."""
        return joint.partition("_")[2].startswith(self.legs)

    def is_waist(self, joint: str) -> bool:
        """Return whether a joint belongs to the waist."""
        return joint.startswith(self.waist)
