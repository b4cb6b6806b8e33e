"""What an environment cannot be made of is said before a robot is simulated."""

import numpy as np
import pytest
import small_world

from cref_jax import config
from cref_jax.env.world import make_world
from cref_jax.errors import ConfigError

GAP = {"name": "gap", "levels": 2}


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (
            {"command": {"open_kinds": ["flatt"]}},
            "--command.open-kinds: unknown kind 'flatt'; did you mean 'flat'",
        ),
        # lanes of 12 m, won 1 m before their end
        ({"episode": {"start_x": [0.5, 3.0]}, "terrain": GAP}, "up to 3 m .* may begin at 1.5 m"),
        ({"episode": {"lane_end": 11.5}, "terrain": GAP}, "up to 1 m .* is at 0.5 m"),
    ],
)
def test_lanes_and_starts_that_do_not_go_together_are_refused(world, changes, says):
    c = config.override(small_world.C, changes)
    with pytest.raises(ConfigError, match=says):
        make_world(c, world.physics)


def test_a_map_whose_start_leaves_no_way_to_walk_is_named(world, tmp_path):
    np.save(tmp_path / "hill.npy", np.zeros((60, 40)))
    (tmp_path / "hill.toml").write_text("cell = 0.1\nstart = [5.5, 2.0]\nscale = 1.0\n")
    c = config.override(small_world.C, {"terrain": {"name": str(tmp_path / "hill.npy")}})
    # 0.5 m are left beyond the start at x = 0.75 m; the goal lies 1 m before the end, at 0.25 m,
    # and robots begin up to 1 m along the lane
    with pytest.raises(ConfigError, match=r"hill.toml: start .* up to 0.75 m past its goal"):
        make_world(c, world.physics)


def test_a_payload_that_outweighs_the_trunk_is_refused(world):
    # the X2's torso weighs 10.14 kg
    c = config.override(small_world.C, {"randomisation": {"trunk_mass": 10.2}})
    with pytest.raises(ConfigError, match=r"trunk-mass must be below 10.1 kg, .* not 10.2"):
        make_world(c, world.physics)
