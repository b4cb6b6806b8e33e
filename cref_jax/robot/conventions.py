"""Whether an MJCF keeps the conventions that the rest of the program relies on."""

from collections.abc import Iterator

import mujoco

from cref_jax.errors import ConfigError
from cref_jax.robot.description import Description


def check_conventions(spec: mujoco.MjSpec, robot: Description) -> None:
    """Refuse a model that does not keep the conventions of `description`.

    Raises:
        ConfigError: the first one that is not kept, and what would be right.
    """
    for complaint in _complaints(spec, robot):
        raise ConfigError(f"{robot.xml.name}: {complaint}")


def _complaints(spec: mujoco.MjSpec, robot: Description) -> Iterator[str]:
    """Yield complaints about joints, motors, bodies, geoms and sites, in this order."""
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
    wanted = [("body", name) for name in (robot.base, *robot.feet)]
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
