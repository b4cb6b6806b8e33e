"""A robot that somebody else has made, as docs/your_robot.md says."""

from pathlib import Path

from cref_jax.robot.description import Description

BIPED = Description(
    title="Biped",
    xml=Path(__file__).parents[1] / "data" / "biped.xml",
    nominal_pose={"hip_pitch": -0.3, "knee": 0.6, "ankle_pitch": -0.3},
    hands=("left_shoulder_pitch_link", "right_shoulder_pitch_link"),
    legs=("hip", "knee", "ankle"),
    waist=(),
    base="base",
    trunk="trunk",
    feet=("left_ankle_roll_link", "right_ankle_roll_link"),
    soles=("left_sole", "right_sole"),
    hip_xz=("hip_roll",),
    ankle_x=("ankle_roll",),
    in_view=("thigh", "shank", "foot"),
    kept_clear=("trunk", "thigh"),
    base_height=0.422,  # 2 x 0.2 m cos(0.3) + 0.04 m
    base_above_ankles=0.382,
    fallen_below=0.1,
    feet_apart=0.16,
    sole_x=(-0.05, 0.09, 5),
    sole_y=(-0.04, 0.04, 3),
    camera_pitch=45.0,
)
