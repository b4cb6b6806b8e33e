"""All robots, one line each."""

from cref_jax.config import describe_unknown
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
