"""The AGIBOT X2 Ultra as data, and the model to train on, derived from its MJCF.

Masses, limits and gains stand in `x2_ultra.xml` and are read off the compiled model; the
nominal pose and the roles of joints and links stand in `x2_ultra.py`.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from cref_jax import config
from cref_jax.robot import x2_ultra
from cref_jax.robot.x2_ultra import IN_VIEW, KEPT_CLEAR, LEG_JOINTS, XML

Actuated = Literal["legs", "legs+waist", "all"]
MOVING: dict[str, Actuated] = {"none": "legs", "waist": "legs+waist", "all": "all"}  # at least
FRICTION = 0.9  # of a contact sphere on the ground; assumed: rubber on a dry floor


class Spheres(NamedTuple):
    """Where the robot touches the world: S = 16 spheres, six under each foot, two on each shank."""

    names: tuple[str, ...]
    body: Int[np.ndarray, " S"]  # body id in the model of `spec`
    position: Float[np.ndarray, "S 3"]  # m, body frame
    radius: Float[np.ndarray, " S"]  # m
    foot: Int[np.ndarray, " S"]  # 0 left sole, 1 right sole, -1 a shank


class Capsules(NamedTuple):
    """The shape of the links, for the depth image and for noticing a fall."""

    names: tuple[str, ...]
    body: Int[np.ndarray, " C"]  # body id in the model of `spec`
    start: Float[np.ndarray, "C 3"]  # m, body frame
    end: Float[np.ndarray, "C 3"]  # m, body frame
    radius: Float[np.ndarray, " C"]  # m
    in_view: Bool[np.ndarray, " C"]  # may appear in front of the camera
    kept_clear: Bool[np.ndarray, " C"]  # never touches the ground unless the robot has fallen


class Mount(NamedTuple):
    """Where something is fixed to the robot; x points forward, z up in the nominal pose."""

    body: int  # body id in the model of `spec`
    position: Float[np.ndarray, "3"]  # m, body frame
    rotation: Float[np.ndarray, "4"]  # quaternion w, x, y, z, mount to body


@dataclass(frozen=True)
class Robot:
    """The robot as the policy drives it; J actuated joints, in the model's order, SI units.

    The M joints that move are these and, after them, those that are held.
    """

    joint_names: tuple[str, ...]
    nominal_pose: Float[np.ndarray, " J"]  # rad, q0
    rest_pose: Float[np.ndarray, " M"]  # rad, q0 of all joints that move
    kp: Float[np.ndarray, " J"]  # N m/rad
    kd: Float[np.ndarray, " J"]  # N m s/rad
    effort: Float[np.ndarray, " J"]  # N m
    velocity_limit: Float[np.ndarray, " J"]  # rad/s
    range_low: Float[np.ndarray, " J"]  # rad
    range_high: Float[np.ndarray, " J"]  # rad
    action_scale: Float[np.ndarray, " J"]  # rad per unit of action
    hip_xz: Bool[np.ndarray, " J"]  # hip roll and yaw (Table I, hip position)
    ankle_x: Bool[np.ndarray, " J"]  # ankle roll (Table I, ankle position)
    mass: float  # kg
    standing_height: float  # m, pelvis over the soles' plane at q0
    pelvis: int  # body id: the base
    trunk: int  # body id that bears the torso: the torso, or the pelvis where the waist is welded
    ankles: tuple[int, int]  # body ids of the left and the right ankle-roll link: the feet
    spheres: Spheres
    capsules: Capsules
    camera: Mount
    imu: Mount


def load(c: config.Robot) -> Robot:
    """Return the robot with the joints of `c.actuated`, read off the model that moves."""
    model = spec(moving(c), config.Physics(), contact_planes=0, visual=True).compile()
    joints = range(1, model.njnt)  # joint 0 is the pelvis's freejoint
    rest = np.array([x2_ultra.nominal_angle(model.joint(j).name) for j in joints])
    names = tuple(n for j in joints if _moves(n := model.joint(j).name, c.actuated))
    first = slice(len(names))  # legs, waist, arms, head: those that are held come last
    kp, effort = model.actuator_gainprm[first, 0], model.actuator_forcerange[first, 1]
    q0, ranges = rest[first], model.jnt_range[1:][first]
    soles, ankles = _spheres(model), ("left_ankle_roll_link", "right_ankle_roll_link")
    return Robot(
        joint_names=names,
        nominal_pose=q0.astype(np.float32),
        rest_pose=rest.astype(np.float32),
        kp=kp.astype(np.float32),
        kd=-model.actuator_biasprm[first, 2].astype(np.float32),
        effort=effort.astype(np.float32),
        velocity_limit=model.jnt_user[1:, 0][first].astype(np.float32),
        range_low=ranges[:, 0].astype(np.float32),
        range_high=ranges[:, 1].astype(np.float32),
        action_scale=(c.action_scale * effort / kp).astype(np.float32),
        hip_xz=np.array(["hip_roll" in name or "hip_yaw" in name for name in names]),
        ankle_x=np.array(["ankle_roll" in name for name in names]),
        mass=float(model.body_mass.sum()),
        standing_height=_standing_height(model, rest),
        pelvis=model.body("pelvis").id,
        trunk=int(model.geom("torso_link_left").bodyid[0]),
        ankles=(model.body(ankles[0]).id, model.body(ankles[1]).id),
        spheres=soles,
        capsules=_capsules(model),
        camera=_mount(model, "depth_camera"),
        imu=_mount(model, "imu"),
    )


def moving(c: config.Robot) -> Actuated:
    """Return which joints move: those that the policy drives, and those that are held."""
    return max(c.actuated, MOVING[c.held], key=get_args(Actuated).index)


def spec(
    moves: Actuated, physics: config.Physics, contact_planes: int = 1, visual: bool = False
) -> mujoco.MjSpec:
    """Return the model in which only the joints of `moves` do.

    The others are welded at the nominal pose, and links that no joint moves any more are fused
    with their parent. Each contact sphere gets `contact_planes` mocap bodies, each with a plane
    that only this sphere collides with: the caller keeps it tangent to the ground. Body, geom and
    pair have the name `plane_{sphere}_{k}`; the mocap bodies come in the order sphere, then k.
    Without `visual`, the shapes that take no part in the physics are left out.
    """
    s = mujoco.MjSpec.from_file(str(XML))
    for joint in s.joints[1:]:
        if not _moves(joint.name, moves):
            _weld(s, joint)
    s.compiler.fusestatic = True
    s.option.timestep = physics.timestep
    s.option.iterations = physics.iterations
    s.option.ls_iterations = physics.line_search
    s.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    s.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    s.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    s.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # a fall is ours to handle
    spheres = [geom.name for geom in s.geoms if geom.type == mujoco.mjtGeom.mjGEOM_SPHERE]
    if not visual:
        for geom in s.geoms:
            if geom.name not in spheres:
                s.delete(geom)
    for sphere in spheres:
        for k in range(contact_planes):
            _add_plane(s, sphere, f"plane_{sphere}_{k}")
    return s


def add_force_sensors(spec: mujoco.MjSpec) -> None:
    """Add sensors of the net contact force that each foot exerts, in the world frame."""
    for side in ("left", "right"):
        spec.add_sensor(
            name=f"{side}_foot_force",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=f"{side}_ankle_roll_link",
            intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3, 1],  # net force
        )


def solve_sparsely(spec: mujoco.MjSpec) -> None:
    """Let MuJoCo C skip the zeros of the Hessian: the legs do not act on each other's joints.

    A step of a robot takes a fifth less time. A robot alone is one island, and not worth a search.
    """
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND


def _moves(joint: str, those: Actuated) -> bool:
    """Return whether the joint of this name is one of those."""
    parts = joint.split("_")
    if those == "all":
        return True
    return parts[1] in LEG_JOINTS or (those == "legs+waist" and parts[0] == "waist")


def _weld(s: mujoco.MjSpec, joint: mujoco.MjsJoint) -> None:
    """Fix a hinge at its nominal angle: turn its body there, then take it and its motor away."""
    body, turn, turned = joint.parent, np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, joint.axis, x2_ultra.nominal_angle(joint.name))
    mujoco.mju_mulQuat(turned, body.quat, turn)
    body.quat = turned
    s.delete(s.actuator(joint.name))
    s.delete(joint)


def _add_plane(s: mujoco.MjSpec, sphere: str, name: str) -> None:
    """Add a plane on a mocap body, in contact with one sphere only."""
    body = s.worldbody.add_body(name=name, mocap=True)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.0, 0.0, 1.0],  # without bounds
        contype=0,
        conaffinity=0,
        group=4,
    )
    s.add_pair(
        name=name,
        geomname1=name,
        geomname2=sphere,
        condim=3,
        friction=[FRICTION, FRICTION, 0.005, 0.0001, 0.0001],
    )


def _standing_height(model: mujoco.MjModel, q0: Float[np.ndarray, " M"]) -> float:
    """Return the height of the pelvis over the lowest point of the soles at q0, m."""
    state = mujoco.MjData(model)
    state.qpos[:7], state.qpos[7:] = (0, 0, 0, 1, 0, 0, 0), q0
    mujoco.mj_kinematics(model, state)
    soles = [g for g in range(model.ngeom) if "sole" in model.geom(g).name]
    return -float((state.geom_xpos[soles, 2] - model.geom_size[soles, 0]).min())


def _spheres(model: mujoco.MjModel) -> Spheres:
    """Read the contact spheres, in the model's order."""
    ids = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE)
    names = tuple(model.geom(i).name for i in ids)
    foot = {"left_sole": 0, "right_sole": 1}
    return Spheres(
        names=names,
        body=model.geom_bodyid[ids].astype(np.int32),
        position=model.geom_pos[ids].astype(np.float32),
        radius=model.geom_size[ids, 0].astype(np.float32),
        foot=np.array([foot.get(name.rpartition("_")[0], -1) for name in names], np.int32),
    )


def _capsules(model: mujoco.MjModel) -> Capsules:
    """Read the capsules of the links, in the model's order."""
    ids = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE)
    names = tuple(model.geom(i).name for i in ids)
    axis = np.zeros((len(ids), 3))
    for row, i in enumerate(ids):
        mujoco.mju_rotVecQuat(axis[row], np.array([0.0, 0.0, 1.0]), model.geom_quat[i])
    half = model.geom_size[ids, 1:2] * axis
    has = lambda links: np.array([any(link in name for link in links) for name in names])
    return Capsules(
        names=names,
        body=model.geom_bodyid[ids].astype(np.int32),
        start=(model.geom_pos[ids] - half).astype(np.float32),
        end=(model.geom_pos[ids] + half).astype(np.float32),
        radius=model.geom_size[ids, 0].astype(np.float32),
        in_view=has(IN_VIEW),
        kept_clear=has(KEPT_CLEAR),
    )


def _mount(model: mujoco.MjModel, site: str) -> Mount:
    """Read the pose of a site in its body."""
    found = model.site(site)
    body, position, rotation = found.bodyid[0], found.pos, found.quat
    return Mount(int(body), position.astype(np.float32), rotation.astype(np.float32))
