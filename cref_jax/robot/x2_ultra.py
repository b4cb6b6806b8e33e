"""The AGIBOT X2 Ultra as data: its model file, nominal pose and the roles of its parts."""

from pathlib import Path

XML = Path(__file__).with_suffix(".xml")

NOMINAL_POSE = {  # rad, both sides; a joint not named here is at 0. assumed: flat feet, and the
    "hip_pitch": -0.42,  # pelvis at the 0.55 m above the ankles that Table I asks for
    "knee": 0.83,
    "ankle_pitch": -0.41,
    "shoulder_pitch": 0.2,
    "shoulder_roll": 0.2,  # outward
    "elbow": -0.6,
}
LEG_JOINTS = ("hip", "knee", "ankle")
IN_VIEW = ("hip_yaw", "knee", "ankle_roll", "elbow", "wrist_yaw", "wrist_roll")  # of the camera
KEPT_CLEAR = ("pelvis", "torso", "head_pitch", "hip_yaw")  # on the ground, the robot has fallen


def nominal_angle(joint: str) -> float:
    """Return q0 of a joint by its name, rad; turns about x and z are mirrored on the right."""
    side, _, kind = joint.removesuffix("_joint").partition("_")
    mirrored = side == "right" and kind.endswith(("roll", "yaw"))
    angle = NOMINAL_POSE.get(kind, 0.0)
    return -angle if mirrored and angle else angle
