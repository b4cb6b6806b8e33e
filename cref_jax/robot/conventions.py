"""Whether an MJCF keeps the conventions that the rest of the program relies on."""

import functools
from collections.abc import Iterator

import mujoco
import numpy as np

from cref_jax.errors import ConfigError
from cref_jax.robot.description import Description

MIRRORED = 1e-4  # m, rad or kg by which mirror images may differ, as rounded figures do


def check_conventions(spec: mujoco.MjSpec, robot: Description) -> None:
    """Refuse a model that does not keep the conventions of `description`.

    Raises:
        ConfigError: the first one that is not kept, and what would be right.
    """
    for complaint in _complaints(spec, robot):
        raise ConfigError(f"{robot.xml.name}: {complaint}")


def _complaints(spec: mujoco.MjSpec, robot: Description) -> Iterator[str]:
    """Yield complaints about joints, motors, names, roles, contacts and mirror images."""
    free, hinge = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_HINGE
    joints = list(spec.joints)
    if not joints or joints[0].type != free or joints[0].parent.name != robot.base:
        yield f"the first joint must be the free joint of '{robot.base}'"
    for joint in joints[1:]:
        if joint.type != hinge or any(joint.pos):
            yield f"'{joint.name}' must be a hinge about its body's origin"
        if not joint.range[0] < joint.range[1]:
            yield f"'{joint.name}' must have a range"
        if not len(joint.userdata) or not joint.userdata[0] > 0.0:
            yield f"'{joint.name}' must have its speed limit, rad/s, as the first value of user"
    yield from _of_motors(spec, [joint.name for joint in joints[1:]])
    yield from _of_names(spec, robot)
    yield from _of_roles(spec, robot)
    yield from _of_contacts(spec)
    yield from _of_mirror_images(spec)


def _of_motors(spec: mujoco.MjSpec, joints: list[str]) -> Iterator[str]:
    if [motor.target for motor in spec.actuators] != joints:
        yield "actuators must be one per joint, in the joints' order"
    for motor in spec.actuators:
        if not motor.gainprm[0] > 0.0 or not motor.forcerange[1] > 0.0:
            yield f"the actuator of '{motor.target}' must be a position one with kp and forcerange"


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


def _of_contacts(spec: mujoco.MjSpec) -> Iterator[str]:
    """Yield complaints about what the simulation adds by itself, or has no use for."""
    for geom in spec.geoms:
        if geom.contype or geom.conaffinity:
            yield f"geom '{geom.name}' must have contype and conaffinity 0"
    parts = {
        "sensors": spec.sensors, "keyframes": spec.keys, "contact pairs": spec.pairs,
        "equalities": spec.equalities, "tendons": spec.tendons,
    }  # fmt: skip
    for what, found in parts.items():
        if found:
            yield f"it must have no {what}"


def _of_mirror_images(spec: mujoco.MjSpec) -> Iterator[str]:
    """Yield a complaint about each part whose partner is not its mirror image."""
    polar, axial = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])
    near = functools.partial(np.allclose, rtol=0.0, atol=MIRRORED)
    for right in (body for body in spec.bodies if body.name.startswith("right_")):
        left = spec.body("left_" + right.name.removeprefix("right_"))
        same = left and near(polar * left.pos, right.pos) and near(left.mass, right.mass)
        if not same or not near(polar * left.ipos, right.ipos):
            yield f"'{right.name}' must be the mirror image of the left one"
    for right in (joint for joint in spec.joints if joint.name.startswith("right_")):
        left = spec.joint("left_" + right.name.removeprefix("right_"))
        turn = float(np.dot(axial * left.axis, right.axis)) if left else 0.0  # 1 or -1
        if not near(abs(turn), 1.0) or not near(
            left.range if turn > 0.0 else -left.range[::-1], right.range
        ):
            yield f"'{right.name}' must have the mirrored axis and range of the left one"
