"""Films of failed trials, from the poses that were recorded as they were counted."""

from pathlib import Path
from typing import Any

from cref_jax import robot
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.evaluation.witness import Failure
from cref_jax.rendering import robot_scene, video

WIDTH, HEIGHT = 480, 270  # pixels; a page holds several films
RATE = 12.5  # 1/s, frames: a film takes six seconds of one core without a GPU
SHADOW = 1024  # pixels of the shadow map, enough for so small a picture


def write(world: World, failures: list[Failure], folder: Path) -> list[dict[str, Any]]:
    """Film failed trials into `folder`; return the rows of eval.json.

    Where there is no OpenGL, or a film cannot be written, a row has `why` instead of `file`.
    """
    return [_write_film(world, failure, folder) for failure in failures]


def describe(row: dict[str, Any], folder: Path) -> str:
    """Say in one line what was filmed, in a file under `folder`, or why nothing was."""
    if "why" in row:
        return f"no film of failures: {row['why']}"
    return f"wrote {folder / row['file']}: {row['ending']} after {row['seconds']:.1f} s"


def _write_film(world: World, failure: Failure, folder: Path) -> dict[str, Any]:
    level = failure.cell.get("level")
    name = "-".join([failure.cell["kind"], *([level] if level else [])]) + ".mp4"
    row = {
        **failure.cell,
        "lane": world.lanes.kinds[failure.lane[0]],
        "failures": failure.failures,
        "trial": failure.number,
        "ending": failure.ending,
        "seconds": round(failure.seconds, 2),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _draw(world, failure, folder / name)
    except (ConfigError, OSError) as error:
        return {**row, "why": str(error)}
    return {**row, "file": f"{folder.name}/{name}"}


def _draw(world: World, failure: Failure, out: Path) -> None:
    c, (kind, level) = world.config, failure.lane
    period = c.physics.control_period
    ground = world.lanes.tile(level, kind)
    model = robot_scene.build(robot.moving(c.robot), c.physics, ground, c.robot.name)
    model.vis.quality.shadowsize = SHADOW
    stride = max(1, round(1.0 / (RATE * period)))
    look_at = robot_scene.camera_path(failure.qpos, period)
    with robot_scene.Canvas(model, WIDTH, HEIGHT) as canvas:
        moments = range(0, len(failure.qpos), stride)
        frames = (canvas.draw(failure.qpos[t], look_at[t]) for t in moments)
        video.write_video(out, frames, 1.0 / (stride * period))
