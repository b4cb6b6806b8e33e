"""All robots, one line each."""

from dataclasses import replace

from cref_jax.config import Config, describe_unknown
from cref_jax.errors import ConfigError
from cref_jax.robot.description import Description
from cref_jax.robot.x2_ultra import X2_ULTRA

ROBOTS = {
    "x2_ultra": X2_ULTRA,
}


def describe(name: str) -> Description:
    """Return the data of a robot by the name that settings give it.

    Raises:
        ConfigError: there is no such robot.
    """
    if name not in ROBOTS:
        raise ConfigError(describe_unknown("robot", name, list(ROBOTS)))
    return ROBOTS[name]


def fill_in(c: Config) -> Config:
    """Put the robot's own numbers in place of the settings that are None.

    Raises:
        ConfigError: there is no such robot.
    """
    data = describe(c.robot.name)
    given = lambda value, own: own if value is None else value
    reward, scan, episode = c.reward, c.scan, c.episode
    return replace(
        c,
        reward=replace(
            reward,
            feet_y_target=given(reward.feet_y_target, data.feet_apart),
            base_height_target=given(reward.base_height_target, data.base_above_ankles),
        ),
        scan=replace(scan, base_height=given(scan.base_height, data.base_height)),
        episode=replace(episode, min_height=given(episode.min_height, data.fallen_below)),
    )
