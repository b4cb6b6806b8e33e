"""All robots, one line each."""

from dataclasses import replace

from cref_jax.config import Config, describe_unknown
from cref_jax.errors import ConfigError
from cref_jax.robot.description import Description
from cref_jax.robot.g1.description import G1
from cref_jax.robot.x2_ultra.description import X2_ULTRA

ROBOTS = {  # the first is taken where settings name none
    "x2_ultra": X2_ULTRA,
    "g1": G1,
}


def describe(name: str | None) -> Description:
    """Return the data of a robot by the name that settings give it.

    Raises:
        ConfigError: there is no such robot.
    """
    name = name_robot(name)
    if name not in ROBOTS:
        raise ConfigError(describe_unknown("robot", name, list(ROBOTS)))
    return ROBOTS[name]


def name_robot(name: str | None) -> str:
    """Return the name itself, or that of the first robot for None."""
    return name or next(iter(ROBOTS))


def fill_in(c: Config, robot: str | None = None) -> Config:
    """Put a robot's name and own numbers in place of the settings that are None.

    It is the robot of this name, or that of the settings where none is given.

    Raises:
        ConfigError: there is no such robot.
    """
    name = name_robot(robot or c.robot.name)
    data = describe(name)
    given = lambda value, own: own if value is None else value
    reward, foothold = c.reward, c.foothold
    return replace(
        c,
        robot=replace(c.robot, name=name),
        reward=replace(
            reward,
            feet_y_target=given(reward.feet_y_target, data.feet_apart),
            base_height_target=given(reward.base_height_target, data.base_above_ankles),
        ),
        scan=replace(c.scan, base_height=given(c.scan.base_height, data.base_height)),
        episode=replace(c.episode, min_height=given(c.episode.min_height, data.fallen_below)),
        camera=replace(c.camera, pitch=given(c.camera.pitch, data.camera_pitch)),
        foothold=replace(
            foothold,
            quality_x=given(foothold.quality_x, data.sole_x),
            quality_y=given(foothold.quality_y, data.sole_y),
        ),
    )
