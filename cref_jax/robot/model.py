"""The model to train on, derived from a robot's MJCF, and the numbers read off it.

Masses, limits and gains stand in the MJCF; the nominal pose and the roles of joints and links in
the robot's `Description`.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from cref_jax import config
from cref_jax.robot.conventions import check_conventions, read
from cref_jax.robot.description import Description
from cref_jax.robot.registry import describe

Actuated = Literal["legs", "legs+waist", "all"]
MOVING: dict[str, Actuated] = {"none": "legs", "waist": "legs+waist", "all": "all"}  # at least
FRICTION = 0.9  # of a contact sphere on the ground; assumed: rubber on a dry floor


class Spheres(NamedTuple):
    """Contact spheres, S under feet and on shanks."""

    names: tuple[str, ...]
    body: Int[np.ndarray, " S"]  # body id in the model of `spec`
    position: Float[np.ndarray, "S 3"]  # m, body frame
    radius: Float[np.ndarray, " S"]  # m
    foot: Int[np.ndarray, " S"]  # 0 left sole, 1 right sole, -1 a shank


class Capsules(NamedTuple):
    """Shapes of the links, for the depth image and for detecting a fall."""

    names: tuple[str, ...]
    body: Int[np.ndarray, " C"]  # body id in the model of `spec`
    start: Float[np.ndarray, "C 3"]  # m, body frame
    end: Float[np.ndarray, "C 3"]  # m, body frame
    radius: Float[np.ndarray, " C"]  # m
    in_view: Bool[np.ndarray, " C"]  # may appear in front of the camera
    kept_clear: Bool[np.ndarray, " C"]  # never touches the ground unless the robot has fallen


class Mount(NamedTuple):
    """Pose of something fixed to the robot; x forward, z up in the nominal pose."""

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

    @property
    def num_joints(self) -> int:
        """J, the number of actuated joints."""
        return len(self.joint_names)


def load(c: config.Robot) -> Robot:
    """Read the robot with the joints of `c.actuated` from its compiled model."""
    data = describe(c.name)
    model = spec(moving(c), config.Physics(), 0, visual=True, name=c.name).compile()
    joints = [model.joint(j).name for j in range(1, model.njnt)]  # joint 0 is the base's
    rest = np.array([data.nominal_angle(joint) for joint in joints])
    names = tuple(joint for joint in joints if _moves(data, joint, c.actuated))
    first = slice(len(names))  # legs, waist, arms, head: those that are held come last
    kp, effort = model.actuator_gainprm[first, 0], model.actuator_forcerange[first, 1]
    q0, ranges = rest[first], model.jnt_range[1:][first]
    has = lambda kinds: np.array([any(kind in name for kind in kinds) for name in names])
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
        hip_xz=has(data.hip_xz),
        ankle_x=has(data.ankle_x),
        mass=float(model.body_mass.sum()),
        standing_height=_standing_height(model, rest, data),
        pelvis=model.body(data.base).id,
        trunk=int(model.geom(data.trunk).bodyid[0]),
        ankles=(model.body(data.feet[0]).id, model.body(data.feet[1]).id),
        spheres=_spheres(model, data),
        capsules=_capsules(model, data),
        camera=_mount(model, data.camera),
        imu=_mount(model, data.imu),
    )


def moving(c: config.Robot) -> Actuated:
    """Return which joints move: driven by the policy, or held."""
    return max(c.actuated, MOVING[c.held], key=get_args(Actuated).index)


def spec(
    moves: Actuated,
    physics: config.Physics,
    contact_planes: int = 1,
    visual: bool = False,
    name: str | None = None,
) -> mujoco.MjSpec:
    """Build the model of the robot `name` in which only the joints of `moves` move.

    Without a name it is the first robot. The other joints are welded at the nominal pose, and links
    that no joint moves any more are fused with their parent. Each contact sphere gets
    `contact_planes` mocap bodies, each with a plane that only this sphere collides with: the caller
    keeps it tangent to the ground. Body, geom and pair have the name `plane_{sphere}_{k}`; the
    mocap bodies come in the order sphere, then k. Without `visual`, the shapes that take no part in
    the physics are left out.

    Raises:
        ConfigError: there is no such robot, or its MJCF does not keep the conventions.
    """
    data = describe(name)
    s = read(data)
    check_conventions(s, data)
    for joint in s.joints[1:]:
        if not _moves(data, joint.name, moves):
            _weld(s, joint, data.nominal_angle(joint.name))
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


def add_force_sensors(spec: mujoco.MjSpec, name: str | None = None) -> None:
    """Add sensors of the net contact force that each foot exerts, in the world frame."""
    for foot in describe(name).feet:
        spec.add_sensor(
            name=f"{foot}_force",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=foot,
            intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3, 1],  # net force
        )


def solve_sparsely(spec: mujoco.MjSpec) -> None:
    """Let MuJoCo C skip the Hessian's zeros: the legs do not act on each other's joints.

    A step of a robot takes a fifth less time. A robot alone is one island, and not worth a search.
    """
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND


def _moves(data: Description, joint: str, those: Actuated) -> bool:
    """Return whether the joint of this name is one of those."""
    if those == "all":
        return True
    return data.is_leg(joint) or (those == "legs+waist" and data.is_waist(joint))


def _weld(s: mujoco.MjSpec, joint: mujoco.MjsJoint, angle: float) -> None:
    """Fix a hinge at an angle, rad: turn its body there, then take it and its motor away."""
    body, turn, turned = joint.parent, np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, joint.axis, angle)
    mujoco.mju_mulQuat(turned, body.quat, turn)
    body.quat = turned
    s.delete(next(motor for motor in s.actuators if motor.target == joint.name))
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


def _standing_height(
    model: mujoco.MjModel, q0: Float[np.ndarray, " M"], data: Description
) -> float:
    """Compute the height of the base over the lowest point of the soles at q0, m."""
    state = mujoco.MjData(model)
    state.qpos[:7], state.qpos[7:] = (0, 0, 0, 1, 0, 0, 0), q0
    mujoco.mj_kinematics(model, state)
    soles = [g for g in range(model.ngeom) if model.geom(g).name.startswith(data.soles)]
    return -float((state.geom_xpos[soles, 2] - model.geom_size[soles, 0]).min())


def _spheres(model: mujoco.MjModel, data: Description) -> Spheres:
    """Read the contact spheres, in the model's order."""
    ids = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE)
    names = tuple(model.geom(i).name for i in ids)
    return Spheres(
        names=names,
        body=model.geom_bodyid[ids].astype(np.int32),
        position=model.geom_pos[ids].astype(np.float32),
        radius=model.geom_size[ids, 0].astype(np.float32),
        foot=np.array([_foot_of(name, data) for name in names], np.int32),
    )


def _foot_of(sphere: str, data: Description) -> int:
    """Return 0 for a sphere under the left sole, 1 under the right one, -1 elsewhere."""
    return next((k for k, sole in enumerate(data.soles) if sphere.startswith(sole)), -1)


def _capsules(model: mujoco.MjModel, data: Description) -> Capsules:
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
        in_view=has(data.in_view),
        kept_clear=has(data.kept_clear),
    )


def _mount(model: mujoco.MjModel, site: str) -> Mount:
    """Read the pose of a site in its body."""
    found = model.site(site)
    body, position, rotation = found.bodyid[0], found.pos, found.quat
    return Mount(int(body), position.astype(np.float32), rotation.astype(np.float32))
