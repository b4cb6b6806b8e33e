"""Whether an MJCF keeps the conventions that the rest of the program relies on."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from typing import Any, get_args, get_origin

import mujoco
import numpy as np
from jaxtyping import Float

from cref_jax.errors import ConfigError
from cref_jax.robot.description import Description

MIRRORED = 1e-4  # m, rad, kg or the like by which mirror images may differ, as rounded figures do
INERTIA = 1e-2  # of its trace, by which an inertia may; assumed: small ones have few digits
ASIDE = 5e-3  # m, of a centre of mass in the middle; assumed: trunks carry a little on one side
FASTEST = 100.0  # rad/s; assumed: joints of robots reach a third of it
TURNED = 0.1  # of a site's axis, nearly rad; assumed: beyond 6 deg it is no alignment
GRAVITY = (0.0, 0.0, -9.81)  # m/s^2; MuJoCo's own
POLAR, AXIAL = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])  # of a mirror


def read(robot: Description) -> mujoco.MjSpec:
    """Read a robot's MJCF as it is written.

    Raises:
        ConfigError: there is no such file, or MuJoCo cannot read it.
    """
    with _named(robot):
        return mujoco.MjSpec.from_file(str(robot.xml))


def check_conventions(spec: mujoco.MjSpec, robot: Description) -> None:
    """Refuse a model that does not keep the conventions of `description`.

    Raises:
        ConfigError: the first one that is not kept, and what would be right.
    """
    for complaint in _complaints(spec, robot):
        raise ConfigError(f"{robot.xml.name}: {complaint}")


@contextmanager
def _named(robot: Description) -> Iterator[None]:
    """Turn what MuJoCo says of a model into one line with its file's name."""
    try:
        yield
    except ValueError as error:
        raise ConfigError(f"{robot.xml.name}: {' '.join(str(error).split())}") from error


def _complaints(spec: mujoco.MjSpec, robot: Description) -> Iterator[str]:
    """Yield complaints about joints, motors, names, roles, contacts and mirror images."""
    yield from _of_description(robot)
    free, hinge = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_HINGE
    joints = list(spec.joints)
    if not joints or joints[0].type != free or joints[0].parent.name != robot.base:
        yield f"the first joint must be the free joint of '{robot.base}'"
    for joint in joints[1:]:
        if joint.type != hinge or any(joint.pos):
            yield f"'{joint.name}' must be a hinge about its body's origin"
        if not len(joint.userdata) or not joint.userdata[0] > 0.0:
            yield f"'{joint.name}' must have its speed limit, rad/s, as the first value of user"
        elif joint.userdata[0] > FASTEST:
            yield f"'{joint.name}' must have a speed limit of {FASTEST:g} rad/s at most, not deg/s"
    if [motor.target for motor in spec.actuators] != [joint.name for joint in joints[1:]]:
        yield "actuators must be one per joint, in the joints' order"
    yield from _of_names(spec, robot)
    yield from _of_roles(spec, robot)
    yield from _of_feet_and_hands(spec, robot)
    yield from _of_contacts(spec)
    with _named(robot):
        model = spec.copy().compile()  # with what the compiler works out, such as masses of shapes
    yield from _of_physics(model)
    yield from _of_mirror_images(spec, model, robot)
    yield from _of_pose(model, robot)


def _of_description(robot: Description) -> Iterator[str]:
    """Yield a complaint about each field that is a text or of another length than is declared."""
    for field in fields(robot):
        value, parts = getattr(robot, field.name), get_args(field.type)
        if get_origin(field.type) is not tuple:
            continue
        if not isinstance(value, tuple) or (... not in parts and len(value) != len(parts)):
            yield f"{field.name} must be a {field.type}, not {value!r}: one name needs a comma too"


def _of_physics(model: mujoco.MjModel) -> Iterator[str]:
    """Yield complaints about joints, motors and gravity that are not as training computes them."""
    for number in range(1, model.njnt):
        name = model.joint(number).name
        if not model.jnt_limited[number]:
            yield f"'{name}' must have a range"
        if model.qpos0[model.jnt_qposadr[number]] or model.jnt_actfrclimited[number]:
            yield f"'{name}' must have neither ref nor actuatorfrcrange"
        if not _is_servo(model, number - 1):
            yield f"the actuator of '{name}' must be a position one with kp, kv, forcerange alone"
    if not np.array_equal(model.opt.gravity, GRAVITY):
        yield "gravity must be 0 0 -9.81"


def _is_servo(model: mujoco.MjModel, motor: int) -> bool:
    """Check that a motor's torque is kp (target - q) - kd qd, within limits that are the same."""
    kp, least, most = model.actuator_gainprm[motor, 0], *model.actuator_forcerange[motor]
    offset, slope, damping = model.actuator_biasprm[motor, :3]
    kinds = [model.actuator_gaintype, model.actuator_biastype, model.actuator_dyntype]
    servo = [mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE, mujoco.mjtDyn.mjDYN_NONE]
    is_bare = model.actuator_gear[motor, 0] == 1.0 and not model.actuator_ctrllimited[motor]
    is_limited = model.actuator_forcelimited[motor] and most == -least
    is_damped = kp > 0.0 and (offset, slope) == (0.0, -kp) and damping < 0.0
    return all([is_bare, is_limited, is_damped, [kind[motor] for kind in kinds] == servo])


def _of_names(spec: mujoco.MjSpec, robot: Description) -> Iterator[str]:
    names = {
        "body": {body.name for body in spec.bodies},
        "geom": {geom.name for geom in spec.geoms},
        "site": {site.name for site in spec.sites},
    }
    wanted = [("body", name) for name in (robot.base, *robot.feet, *robot.hands)]
    wanted += [("geom", robot.trunk), ("site", robot.camera), ("site", robot.imu)]
    for what, name in wanted:
        if name not in names[what]:
            yield f"there is no {what} '{name}'"
    spheres = [g.name for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_SPHERE]
    for sole in robot.soles:
        if not any(name.startswith(sole) for name in spheres):
            yield f"there is no sphere whose name begins with '{sole}'"
    for what in ("feet", "soles", "hands"):
        left, right = getattr(robot, what)
        if not left.startswith("left_") or right != _other_side(left):
            yield f"{what} must be named left_ first and then right_, not '{left}', '{right}'"
    both = set().union(*names.values()) | {joint.name for joint in spec.joints}
    for name in sorted(both):
        for side, other in (("left_", "right_"), ("right_", "left_")):
            if name.startswith(side) and other + name.removeprefix(side) not in both:
                yield f"'{name}' has no '{other + name.removeprefix(side)}'"


def _of_roles(spec: mujoco.MjSpec, robot: Description) -> Iterator[str]:
    """Yield a complaint about each name of a role or pose that is no part's."""
    joints = [joint.name for joint in spec.joints[1:]]
    kinds = {joint.removesuffix("_joint").partition("_")[2] for joint in joints}
    for kind in robot.nominal_pose:
        if kind not in kinds:
            yield f"no joint is a '{kind}' of the nominal pose"
    if not any(robot.is_leg(joint) for joint in joints):
        yield f"no joint is one of the legs, {', '.join(robot.legs)}"
    for joint in joints:
        if robot.is_leg(joint) and _other_side(joint) == joint:
            yield f"'{joint}' is one of the legs, and must begin with left_ or right_"
    ranks = [0 if robot.is_leg(j) else 1 if robot.is_waist(j) else 2 for j in joints]
    for joint, rank, before in zip(joints[1:], ranks[1:], ranks, strict=False):
        if rank < before:
            yield f"'{joint}' comes too late: the order is legs, waist, all others"
    capsules = [g.name for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_CAPSULE]
    for what, names, parts in (
        ("joint", (*robot.hip_xz, *robot.ankle_x), joints),
        ("capsule", (*robot.in_view, *robot.kept_clear), capsules),
    ):
        for name in names:
            if not any(name in part for part in parts):
                yield f"no {what} has '{name}' in its name"


def _of_feet_and_hands(spec: mujoco.MjSpec, robot: Description) -> Iterator[str]:
    """Yield complaints about those that no joint moves, and spheres of soles elsewhere."""
    for what in (*robot.feet, *robot.hands):
        moved = _moved(spec.body(what))
        if moved.name != what:
            yield f"'{what}' has no joint: its Description must name '{moved.name}' instead"
    for foot, sole in zip(robot.feet, robot.soles, strict=True):
        for geom in spec.geoms:
            is_sole = geom.type == mujoco.mjtGeom.mjGEOM_SPHERE and geom.name.startswith(sole)
            if is_sole and _moved(geom.parent).name != foot:
                yield f"'{geom.name}' must be on '{foot}' itself: a toe joint is not supported"


def _moved(body: mujoco.MjsBody) -> mujoco.MjsBody:
    """Find the body with a joint that this one is fixed to, or the world."""
    while not body.joints and body.parent:
        body = body.parent
    return body


def _of_contacts(spec: mujoco.MjSpec) -> Iterator[str]:
    """Yield complaints about what the simulation adds by itself, or has no use for."""
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_SPHERE and not geom.name:
            yield f"each sphere of '{geom.parent.name}' must have a name"
        if geom.contype or geom.conaffinity:
            yield f"geom '{geom.name}' must have contype and conaffinity 0"
    parts = {
        "sensors": spec.sensors, "keyframes": spec.keys, "contact pairs": spec.pairs,
        "equalities": spec.equalities, "tendons": spec.tendons,
    }  # fmt: skip
    for what, found in parts.items():
        if found:
            yield f"it must have no {what}"


def _of_mirror_images(
    spec: mujoco.MjSpec, model: mujoco.MjModel, robot: Description
) -> Iterator[str]:
    """Yield a complaint about each part whose partner is not its mirror image."""
    names = [model.body(number).name for number in range(model.nbody)]
    for right, name in enumerate(names):
        other = _other_side(name)
        if other == name and abs(model.body_ipos[right, 1]) > ASIDE:
            yield f"'{name}' must have its centre of mass in the middle, within {1e3 * ASIDE:g} mm"
        if not name.startswith("right_"):
            continue
        left = names.index(other) if other in names else 0
        if not left or not _bodies_mirror(model, left, right):
            yield f"'{name}' must be the mirror image of the left one"
        if not _shapes_mirror(model, left, right):
            yield f"a capsule or sphere of '{name}' must be the mirror image of one on the left"
    for right in (joint for joint in spec.joints if joint.name.startswith("right_")):
        yield from _of_joint_pair(model, spec.joint(_other_side(right.name)), right, robot)


def _of_pose(model: mujoco.MjModel, robot: Description) -> Iterator[str]:
    """Yield complaints about joints beyond their range and sites that are turned in that pose."""
    state = mujoco.MjData(model)
    state.qpos[:7] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    for number in range(1, model.njnt):
        name, (low, high) = model.joint(number).name, model.jnt_range[number]
        angle = robot.nominal_angle(name)
        if not low <= angle <= high:
            yield f"'{name}' goes {low:.3g} to {high:.3g} rad, never {angle:g}: is angle='radian'?"
        state.qpos[model.jnt_qposadr[number]] = angle
    mujoco.mj_kinematics(model, state)
    camera, imu = (state.site(name).xmat.reshape(3, 3) for name in (robot.camera, robot.imu))
    if not np.allclose(imu, np.eye(3), rtol=0.0, atol=TURNED):
        yield f"site '{robot.imu}' must have x forward and z up in the nominal pose"
    down = np.arctan2(-camera[2, 0], camera[0, 0])
    is_level = np.allclose(camera[:, 1], (0.0, 1.0, 0.0), rtol=0.0, atol=TURNED)
    if not is_level or min(np.cos([down, down + np.deg2rad(robot.camera_pitch)])) < TURNED:
        yield f"site '{robot.camera}' must have x forward and z up: camera_pitch comes on top of it"


def _of_joint_pair(
    model: mujoco.MjModel,
    left: mujoco.MjsJoint | None,
    right: mujoco.MjsJoint,
    robot: Description,
) -> Iterator[str]:
    turn = float(np.dot(AXIAL * left.axis, right.axis)) if left else 0.0  # 1 or -1
    if not left or not _near(abs(turn), 1.0) or not _near(_turned(left.range, turn), right.range):
        yield f"'{right.name}' must have the mirrored axis and range of the left one"
        return
    if robot.nominal_angle(right.name) != np.sign(turn) * robot.nominal_angle(left.name):
        yield f"'{right.name}' must turn the other way: its nominal angle mirrors the left one's so"
    if not _near(_drive(model, left.name, turn), _drive(model, right.name, 1.0)):
        yield f"'{right.name}' must have the motor, speed, armature, friction, spring of the left"


def _other_side(name: str) -> str:
    """Name the part on the other side; one without a side is its own."""
    for side, other in (("left_", "right_"), ("right_", "left_")):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


def _near(a: Any, b: Any) -> bool:
    return np.allclose(a, b, rtol=0.0, atol=MIRRORED)


def _mirror(tensor: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    return POLAR[:, None] * tensor * POLAR


def _axes(quat: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "3 3"]:
    """Compute the rotation matrix of a quaternion."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def _inertia(body: Any) -> Float[np.ndarray, "3 3"]:
    axes = _axes(body.iquat)
    return axes @ np.diag(body.inertia) @ axes.T


def _bodies_mirror(model: mujoco.MjModel, left: int, right: int) -> bool:
    """Compare place, orientation, mass, centre of mass and inertia of two bodies."""
    a, b = model.body(left), model.body(right)
    inertia = _inertia(b)
    return (
        _near([POLAR * a.pos, POLAR * a.ipos], [b.pos, b.ipos])
        and _near(_mirror(_axes(a.quat)), _axes(b.quat))
        and _near(a.mass, b.mass)
        and np.allclose(_mirror(_inertia(a)), inertia, rtol=0.0, atol=INERTIA * np.trace(inertia))
    )


def _shapes_mirror(model: mujoco.MjModel, left: int, right: int) -> bool:
    """Check that each capsule or sphere of two bodies has its mirror image."""
    images = [(POLAR * p, _mirror(e), *of) for p, e, *of in _shapes(model, left)]
    shapes = list(_shapes(model, right))
    found = [any(all(map(_near, image, shape)) for image in images) for shape in shapes]
    return len(images) == len(shapes) and all(found)


def _shapes(model: mujoco.MjModel, body: int) -> Iterator[tuple[Any, ...]]:
    """Yield place, extent along the axis, radius and kind of a body's capsules and spheres."""
    capsule, sphere = int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_SPHERE)
    for number in np.flatnonzero(model.geom_bodyid == body):
        kind, size = model.geom_type[number], model.geom_size[number]
        if kind in (capsule, sphere):
            axis = _axes(model.geom_quat[number])[:, 2]  # of either sign
            half = size[1] if kind == capsule else 0.0
            yield model.geom_pos[number], half * np.outer(axis, axis), size[0], kind


def _drive(model: mujoco.MjModel, joint: str, turn: float) -> Float[np.ndarray, " n"]:
    """Collect what moves, limits and brakes a joint, for one that turns the other way if -1."""
    number = model.joint(joint).id
    motor = int(np.flatnonzero(model.actuator_trnid[:, 0] == number)[0])
    dof = model.jnt_dofadr[number]
    parts = (
        model.actuator_gainprm[motor], model.actuator_biasprm[motor],
        _turned(model.actuator_forcerange[motor], turn), model.jnt_user[number][:1],
        model.dof_armature[dof], model.dof_damping[dof], model.dof_frictionloss[dof],
        model.jnt_stiffness[number], turn * model.qpos_spring[model.jnt_qposadr[number]],
    )  # fmt: skip
    return np.concatenate([np.ravel(part) for part in parts])


def _turned(limits: Float[np.ndarray, " 2"], turn: float) -> Float[np.ndarray, " 2"]:
    """Mirror a lower and an upper limit."""
    return limits if turn > 0.0 else -limits[::-1]
