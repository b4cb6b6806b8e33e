"""Draw the twenty out-of-distribution scenes: `python experiments/ood_scenes.py`.

Each is shown with the robot standing in the nominal pose, beside the image of its depth camera;
pixels without a return are drawn at the far plane. Takes seconds.
"""

import cref_jax.system.startup  # noqa: F401

from dataclasses import dataclass
from pathlib import Path

import matplotlib

from cref_jax import config, robot
from cref_jax.config import Config
from cref_jax.rendering import robot_scene, video
from cref_jax.whole_body import ground, scene_files
from cref_jax.whole_body.simulator import WholeBodySim

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import mujoco
import numpy as np
import tyro

COLUMNS = 4
SIZE = (480, 360)  # pixels, with the aspect ratio of the depth image
NEAR = 0.3  # m, lower end of the depth scale
AHEAD = np.array([0.75, 0.0, -0.25])  # m, from the pelvis to the image centre
VIEW = (128.0, -27.0)  # deg, azimuth and elevation
VIEWS = {"walled_stairs": (20.0, -22.0)}  # a wall would hide the robot
PLACES = {  # m along x where the robot stands; by default 1.3 m, before the first obstacle
    "askew_pallets": 1.7,
    "curbs": 2.6,
    "euro_pallets": 2.3,
    "flagstones": 1.5,
    "footbridge": 2.3,
    "grate_over_ditch": 1.9,
    "low_walls": 2.2,
    "pallet_stack": 2.6,
    "planks": 2.1,
    "posts": 2.0,
    "side_clutter": 1.9,
    "steel_grate": 2.2,
    "stringer_pallets": 2.3,
    "trailer_ramp": 4.2,
    "two_handrails": 1.5,
    "walled_stairs": 1.5,
}


@dataclass(frozen=True)
class Options:
    """Draw every scene and its depth image."""

    out: Path = Path(__file__).parent / "figures" / "ood_scenes.png"
    """image to write"""


def main() -> None:
    """Draw all scenes on one sheet."""
    options = tyro.cli(Options)
    c, scenes = Config(), scene_files.load_all()
    rows = -(-len(scenes) // COLUMNS)
    figure = plt.figure(figsize=(4.9 * COLUMNS, 2.15 * rows + 0.8))
    sheet, foot = figure.subfigures(2, 1, height_ratios=[2.15 * rows, 0.8])
    cells = sheet.subfigures(rows, COLUMNS)
    for cell, (name, scene) in zip(cells.flat, scenes.items(), strict=False):
        picture, metres = render_scene(c, scene, PLACES.get(name, 1.3))
        left, right = cell.subplots(1, 2)
        cell.subplots_adjust(left=0.02, right=0.98, bottom=0.14, top=0.99, wspace=0.03)
        left.imshow(picture)
        depth = right.imshow(metres, cmap="viridis_r", vmin=NEAR, vmax=c.camera.d_max)
        left.set_title(scene.title, y=-0.155, fontsize=12, loc="left")
        for axis in (left, right):
            axis.set_axis_off()
    bar = figure.colorbar(
        depth, cax=foot.add_axes((0.35, 0.7, 0.3, 0.15)), orientation="horizontal"
    )
    bar.set_label("depth, m", fontsize=12)
    figure.savefig(options.out, dpi=80)
    print(f"wrote {options.out}")


def render_scene(c: Config, ground: scene_files.Scene, x: float) -> tuple[video.Frame, np.ndarray]:
    """Render the robot at x and its depth image, m; d_max where nothing is hit."""
    body = WholeBodySim(c, ground, robot.load(config.Robot(actuated="all")).joint_names)
    state = mujoco.MjData(body.model)
    state.qpos[:7] = [x, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0]
    state.qpos[7:] = body.robot.nominal_pose
    mujoco.mj_forward(body.model, state)
    state.qpos[2] = body.robot.standing_height + ground_under_soles(body, state) + 0.002
    mujoco.mj_forward(body.model, state)
    depth = body.image(state)
    spec = robot_scene.build_stage("all", c.physics, -scene_files.DITCH - robot_scene.BASE)
    ground.add_to(spec, robot.FRICTION)
    with robot_scene.Canvas(spec.compile(), *SIZE, *VIEWS.get(ground.name, VIEW)) as canvas:
        picture = canvas.draw(state.qpos, state.qpos[:3] + AHEAD)
    return picture, np.where(np.isfinite(depth), np.minimum(depth, c.camera.d_max), c.camera.d_max)


def ground_under_soles(body: WholeBodySim, state: mujoco.MjData) -> float:
    """Measure the highest point of the ground under the soles, m."""
    hit, down = np.zeros(1, np.int32), np.array([0.0, 0.0, -1.0])
    groups = np.array([g == ground.GROUND for g in range(6)], np.uint8)
    spheres, heights = body.robot.spheres, []
    for link, position in zip(spheres.body, spheres.position, strict=True):
        if link in body.feet:
            start = state.xpos[link] + state.xmat[link].reshape(3, 3) @ position
            start[2] = 1.2  # above every step, below every overhead rail
            distance = mujoco.mj_ray(body.model, state, start, down, groups, True, -1, hit)
            heights.append(start[2] - distance)
    return max(heights)


if __name__ == "__main__":
    main()
