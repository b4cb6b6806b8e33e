"""The Unitree G1 with 29 joints as data: its model file, nominal pose and the roles of its parts.

Figures of the model file, of revision 1.0 with rubber hands (`mode_machine` 5), are from:

- unitreerobotics/unitree_ros, robots/g1_description/g1_29dof_rev_1_0.xml and .urdf: masses,
  inertias, link frames, joint ranges, IMU and depth camera; torque and speed limits from the .urdf,
  which is the newer one; extents of the links, to which capsules and soles are fitted.
- mujocolab/mjlab, src/mjlab/asset_zoo/robots/unitree_g1/g1_constants.py: inertias of the rotors and
  gear ratios; the nominal pose.
- unitreerobotics/unitree_rl_gym, deploy/deploy_real/configs/g1.yaml: gains.
"""

from pathlib import Path

from cref_jax.robot.description import Description

G1 = Description(
    title="Unitree G1",
    xml=Path(__file__).with_name("g1.xml"),
    # mjlab's with bent knees, its hips bent by 0.03 rad more: held by the motors alone, without
    # balance, it is then upright for two seconds instead of one. assumed: forearms further down
    nominal_pose={
        "hip_pitch": -0.34,
        "knee": 0.67,
        "ankle_pitch": -0.33,
        "shoulder_pitch": 0.2,
        "shoulder_roll": 0.2,  # outward
        "elbow": 0.97,
    },
    hands=("left_wrist_yaw_link", "right_wrist_yaw_link"),
    legs=("hip", "knee", "ankle"),
    waist=("waist",),
    base="pelvis",
    trunk="torso_link_left",
    feet=("left_ankle_roll_link", "right_ankle_roll_link"),
    soles=("left_sole", "right_sole"),
    hip_xz=("hip_roll", "hip_yaw"),
    ankle_x=("ankle_roll",),
    in_view=("hip_yaw", "knee", "ankle_roll", "elbow", "wrist"),
    kept_clear=("pelvis", "torso", "head", "hip_yaw"),
    base_height=0.757,
    base_above_ankles=0.721,
    fallen_below=0.25,  # assumed: 0.15 m of the hips, which are 0.10 m below the base's origin
    feet_apart=0.237,
    sole_x=(-0.055, 0.13, 5),
    sole_y=(-0.03, 0.03, 3),
    camera_pitch=47.6,
)
