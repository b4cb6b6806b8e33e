"""Draw depth images of each kind of terrain: `python experiments/depth.py`.

The robot stands in the nominal pose, 0.6 m before the first obstacle of each kind of lane at a
medium size; in the last image it lifts a knee into view. Takes seconds.
"""

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro

from cref_jax import config, depth, robot, terrain
from cref_jax.robot import kinematics
from cref_jax.terrain import lanes
from cref_jax.terrain.generators import format_size

BEFORE = 0.6  # m, from the pelvis to the first column not at z = 0
LEVEL = 5  # of 0 to 9


@dataclass(frozen=True)
class Options:
    """Draw the depth image of each kind of terrain."""

    out: Path = Path(__file__).parent / "figures" / "depth.png"
    """image to write"""


def main() -> None:
    """Render one image per kind and draw them side by side."""
    options = tyro.cli(Options)
    c = robot.fill_in(config.Config())
    atlas = lanes.build(config.Terrain(name="mixed"))
    figure, axes = plt.subplots(2, 4, figsize=(11, 4.6), constrained_layout=True)
    views = {
        f"{name}, {format_size(name, atlas.sizes[LEVEL, kind])}": render_view(
            c, atlas.tile(LEVEL, kind), lift=0.0
        )
        for kind, name in enumerate(atlas.kinds)
    }
    views["knee lifted"] = render_view(c, atlas.tile(LEVEL, atlas.kinds.index("flat")), lift=1.0)
    for axis, (title, metres) in zip(axes.flat, views.items(), strict=True):
        image = axis.imshow(metres, cmap="viridis_r", vmin=0.5, vmax=c.camera.d_max)
        axis.set_title(title)
        axis.set_axis_off()
    figure.colorbar(image, ax=axes, label="depth, m")
    figure.savefig(options.out, dpi=110)
    print(f"wrote {options.out}")


def render_view(c: config.Config, ground: terrain.Terrain, lift: float) -> np.ndarray:
    """Render the depth image before the first obstacle, m, with one hip flexed by `lift`, rad."""
    x2 = robot.load(c.robot)
    x = np.arange(0.0, 6.0, ground.cell) + 0.5 * ground.cell
    heights = np.asarray(terrain.height_at(ground, jnp.stack([x, 0.0 * x], 1)))
    obstacle = x[np.argmax(heights != 0.0)] if heights.any() else 1.5
    base = [obstacle - BEFORE, 0.0, x2.standing_height, 1.0, 0.0, 0.0, 0.0]
    joints = x2.rest_pose.copy()
    joints[x2.joint_names.index("left_hip_pitch_joint")] -= lift
    qpos = jnp.concatenate([jnp.array(base), joints])
    spec = robot.spec(robot.moving(c.robot), c.physics, name=c.robot.name)
    tree = kinematics.tree(spec.compile())
    links = kinematics.links(tree, qpos, jnp.zeros(qpos.size - 1))
    position, rotation = depth.pose(links, x2.camera, c.camera, 0.0, jnp.zeros(3))
    capsules = depth.capsules_in_view(links, x2.capsules)
    return np.asarray(depth.render(ground, position, rotation, capsules, c.camera))


if __name__ == "__main__":
    main()
