"""The AGIBOT X2 Ultra as data: its model file, nominal pose and the roles of its parts."""

from pathlib import Path

from cref_jax.robot.description import Description

X2_ULTRA = Description(
    title="AGIBOT X2 Ultra",
    xml=Path(__file__).with_name("x2_ultra.xml"),
    nominal_pose={  # assumed: flat feet, and the pelvis at the 0.55 m above the ankles of Table I
        "hip_pitch": -0.42,
        "knee": 0.83,
        "ankle_pitch": -0.41,
        "shoulder_pitch": 0.2,
        "shoulder_roll": 0.2,  # outward
        "elbow": -0.6,
    },
    hands=("left_wrist_roll_link", "right_wrist_roll_link"),
    legs=("hip", "knee", "ankle"),
    waist=("waist",),
    base="pelvis",
    trunk="torso_link_left",
    feet=("left_ankle_roll_link", "right_ankle_roll_link"),
    soles=("left_sole", "right_sole"),
    hip_xz=("hip_roll", "hip_yaw"),
    ankle_x=("ankle_roll",),
    in_view=("hip_yaw", "knee", "ankle_roll", "elbow", "wrist_yaw", "wrist_roll"),
    kept_clear=("pelvis", "torso", "head_pitch", "hip_yaw"),
    base_height=0.62,
    base_above_ankles=0.55,  # Table I
    # assumed: a foot comes down on a box of 40 cm when the pelvis is still 0.23 m above the box
    fallen_below=0.15,
    feet_apart=0.27,  # Table I
    sole_x=(-0.06, 0.13, 5),
    sole_y=(-0.05, 0.05, 3),
    camera_pitch=50.0,  # Sec. III-A
)
