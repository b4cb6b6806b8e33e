"""Peers for the depth camera and the physics: NVIDIA Warp, mj_multiRay and MuJoCo's batch.

NVIDIA Warp is a dependency of the benchmark alone: `pip install 'cref-jax[bench]'`. On a CPU its
kernels run on one thread, as does MuJoCo's ray-cast.
"""

import importlib.util
import math
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int
from mujoco.batch import Batch

from cref_jax import config, depth, geoms, robot
from cref_jax.physics.records import Body
from cref_jax.physics.simulation import Physics
from cref_jax.rendering import robot_scene
from cref_jax.terrain import Terrain
from cref_jax.whole_body.ground import Lane

CAMERAS = 256
RAY_CAST = 16  # cameras for MuJoCo's ray-cast, which is slow
REPEATS = 8
HEIGHT = (1.0, 1.3)  # m, of the cameras above the ground
TURN = 0.2  # rad, +-, of yaw, pitch and roll about the mounting pose
TILE = 50  # columns, side of the largest box in the box mesh


class Mesh(NamedTuple):
    """A triangle mesh."""

    points: Float[np.ndarray, "P 3"]  # m
    triangles: Int[np.ndarray, "T 3"]


class Speed(NamedTuple):
    """Throughput of a renderer."""

    renderer: str
    frames_per_second: float
    threads: str
    agreement: float  # share of pixels within 1 cm of the march over the columns


def compare_renderers(ground: Terrain, camera: config.Camera, is_profile: bool) -> list[Speed]:
    """Time our renderers, MuJoCo's and, if installed, Warp's on one lane."""
    position, rotation = _sample_poses(ground, camera)
    seconds, reference = _time_own_renderer(ground, position, rotation, camera, is_profile=False)
    speeds = [_to_speed("march over the columns", seconds, "all", reference, reference)]
    if is_profile:
        seconds, images = _time_own_renderer(ground, position, rotation, camera, is_profile=True)
        speeds.append(_to_speed("sweep of the profile", seconds, "all", images, reference))
    heights, origin = robot_scene.window(ground)
    some = slice(0, RAY_CAST)
    lane = Lane(heights, origin, ground.cell, np.inf)
    seconds, images = _time_multi_ray(lane, position[some], rotation[some], camera)
    speeds.append(_to_speed("mj_multiRay", seconds, "1", images, reference[some]))
    if importlib.util.find_spec("warp") is None:
        return speeds
    meshes = {
        "boxes": box_mesh(heights, origin, ground.cell),
        "grid": grid_mesh(heights, origin, ground.cell),
    }
    for name, mesh in meshes.items():
        seconds, images = _time_warp(mesh, position, rotation, camera)
        title = f"NVIDIA Warp, {len(mesh.triangles):,} triangles ({name})"
        speeds.append(_to_speed(title, seconds, "1", images, reference))
    return speeds


def shortest_time(call: Callable[[], object], repeats: int) -> float:
    """Measure the shortest time of `repeats` calls after one warm-up call, s."""
    times = []
    for _ in range(repeats + 1):
        started_at = time.perf_counter()
        call()
        times.append(time.perf_counter() - started_at)
    return min(times[1:])


def box_mesh(
    heights: Float[np.ndarray, "X Y"], origin: Float[np.ndarray, "2"], cell: float
) -> Mesh:
    """Build a mesh of one box per rectangle of equally high columns, with vertical risers."""
    boxes = geoms.merge_boxes(heights, TILE, most=heights.size)
    assert boxes is not None
    low = float(heights.min()) - robot_scene.BASE
    sides = np.array(
        [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    )
    quads = sides[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    points, triangles = [], []
    for first, size, height in zip(boxes.first, boxes.size, boxes.height, strict=True):
        (x0, y0), (x1, y1) = origin + first * cell, origin + (first + size) * cell
        triangles.append(quads + 8 * len(points))
        points.append([(x, y, z) for z in (low, height) for y in (y0, y1) for x in (x0, x1)])
    return Mesh(np.concatenate(points).astype(np.float32), np.concatenate(triangles))


def grid_mesh(
    heights: Float[np.ndarray, "X Y"], origin: Float[np.ndarray, "2"], cell: float
) -> Mesh:
    """Build a mesh with two triangles between four column centres, as in a height field."""
    x, y = (origin[k] + (np.arange(n) + 0.5) * cell for k, n in enumerate(heights.shape))
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), heights], axis=-1).reshape(-1, 3)
    across = heights.shape[1]
    corner = (np.arange(heights.shape[0] - 1)[:, None] * across + np.arange(across - 1)).ravel()
    lower = np.stack([corner, corner + across, corner + 1], axis=1)
    upper = np.stack([corner + 1, corner + across, corner + across + 1], axis=1)
    return Mesh(points.astype(np.float32), np.concatenate([lower, upper]))


def _sample_poses(
    ground: Terrain, camera: config.Camera
) -> tuple[Float[np.ndarray, "E 3"], Float[np.ndarray, "E 3 3"]]:
    """Sample camera poses along the lane: the mounting pose with small random rotations."""
    rng = np.random.default_rng(0)
    heights, origin = robot_scene.window(ground)
    x = origin[0] + rng.uniform(0.05, 0.75, CAMERAS) * heights.shape[0] * ground.cell
    columns = ((x - origin[0]) / ground.cell).astype(int)
    z = heights[columns, heights.shape[1] // 2] + rng.uniform(*HEIGHT, CAMERAS)
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    rotation, quat, matrix = np.empty((CAMERAS, 3, 3)), np.empty(4), np.empty(9)
    for k, (yaw, pitch, roll) in enumerate(rng.uniform(-TURN, TURN, (CAMERAS, 3))):
        down = math.radians(camera.pitch) + pitch
        mujoco.mju_euler2Quat(quat, np.array([yaw, down, roll]), "zyx")
        mujoco.mju_quat2Mat(matrix, quat)
        rotation[k] = matrix.reshape(3, 3) @ level
    position = np.stack([x, np.full(CAMERAS, origin[1] + 0.5 * heights.shape[1] * ground.cell), z])
    return position.T.astype(np.float32), rotation.astype(np.float32)


def _time_own_renderer(
    ground: Terrain,
    position: Float[np.ndarray, "E 3"],
    rotation: Float[np.ndarray, "E 3 3"],
    camera: config.Camera,
    is_profile: bool,
) -> tuple[float, Float[np.ndarray, "E H W"]]:
    """Time our renderer: seconds for all images, and the images, without the robot's capsules."""

    def draw(
        ground: Terrain, position: Float[Array, "3"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "H W"]:
        return depth.render(ground, position, rotation, jnp.zeros((0, 7)), camera, is_profile)

    program = jax.jit(jax.vmap(draw, in_axes=(None, 0, 0)))
    draw_all = lambda: jax.block_until_ready(program(ground, position, rotation))
    return shortest_time(draw_all, REPEATS), np.asarray(draw_all())


def time_raw_substep(
    physics: Physics, bodies: Body, threads: int, steps: int, repeats: int
) -> float:
    """Measure the time of one substep of all robots in MuJoCo's own batch, s.

    The robots stand on level planes, without terrain queries, copies or JAX.
    """
    count = len(bodies.qpos)
    batch, model = Batch(physics.model, count, threads), physics.model
    views = {name: batch.bind(name) for name in ("qpos", "qvel", "qacc_warmstart", "ctrl")}
    targets = np.asarray(physics.robot.rest_pose)
    planes = batch.bind("mocap_pos")
    best = float("inf")
    for _ in range(repeats + 1):
        for view, value in zip(views.values(), (*bodies, targets), strict=True):
            view[:] = value
        planes[:, : model.nmocap] = 0.0
        started_at = time.perf_counter()
        for _ in range(steps):
            batch.step()
        best = min(best, (time.perf_counter() - started_at) / steps)
    return best


def _time_multi_ray(
    lane: Lane,
    position: Float[np.ndarray, "E 3"],
    rotation: Float[np.ndarray, "E 3 3"],
    camera: config.Camera,
) -> tuple[float, Float[np.ndarray, "E H W"]]:
    """Time mj_multiRay: seconds for all images, and the images."""
    spec = mujoco.MjSpec()
    lane.add_to(spec, robot.FRICTION)
    model = spec.compile()
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    rays = _pixel_rays(camera)
    length = np.linalg.norm(rays, axis=1)
    unit, count = rays / length[:, None], len(rays)
    images = np.empty((len(position), count))

    def cast() -> None:
        hit, distance = np.zeros(count, np.int32), np.zeros(count)
        for k in range(len(position)):
            world = (unit @ rotation[k].T.astype(float)).ravel()
            mujoco.mj_multiRay(
                model, state, position[k].astype(float), world, None, True, -1, hit, distance,
                None, count, 1e3,
            )  # fmt: skip
            images[k] = np.where(distance < 0.0, np.inf, distance / length)

    seconds = shortest_time(cast, 1)
    return seconds, np.minimum(images, camera.d_max).reshape(-1, *camera.shape)


def _pixel_rays(camera: config.Camera) -> Float[np.ndarray, "n 3"]:
    """Compute the directions (x, y, 1) of the pixels in row-major order."""
    (h, w), (vertical, horizontal) = camera.shape, camera.view
    tangent = lambda n, view: (2 * (np.arange(n) + 0.5) / n - 1) * np.tan(np.radians(view / 2))
    x, y = np.meshgrid(tangent(w, horizontal), tangent(h, vertical))
    return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)


def _time_warp(
    mesh: Mesh,
    position: Float[np.ndarray, "E 3"],
    rotation: Float[np.ndarray, "E 3 3"],
    camera: config.Camera,
) -> tuple[float, Float[np.ndarray, "E H W"]]:
    """Time NVIDIA Warp: seconds for all images, and the images."""
    import warp as wp  # pyright: ignore[reportMissingImports]

    wp.config.quiet = True

    @wp.kernel
    def cast(
        mesh: wp.uint64,
        position: wp.array(dtype=wp.vec3),  # type: ignore[valid-type]
        rotation: wp.array(dtype=wp.mat33),  # type: ignore[valid-type]
        rays: wp.array(dtype=wp.vec3),  # type: ignore[valid-type]
        farthest: float,
        image: wp.array(dtype=float, ndim=2),  # type: ignore[valid-type]
    ):
        e, k = wp.tid()  # type: ignore[misc]
        hit = wp.mesh_query_ray(mesh, position[e], rotation[e] * rays[k], farthest)
        image[e, k] = wp.where(hit.result, hit.t, farthest)

    rays, (h, w) = _pixel_rays(camera), camera.shape
    array = lambda values, dtype: wp.array(values, dtype=dtype, device="cpu")
    solid = wp.Mesh(array(mesh.points, wp.vec3), array(mesh.triangles.ravel(), wp.int32))
    image = wp.zeros((len(position), h * w), dtype=float, device="cpu")
    inputs = [array(position, wp.vec3), array(rotation, wp.mat33), array(rays, wp.vec3)]
    launch = lambda: wp.launch(
        cast, image.shape, inputs=[solid.id, *inputs, camera.d_max, image], device="cpu"
    )
    return shortest_time(launch, REPEATS), image.numpy().reshape(-1, h, w).copy()


def _to_speed(
    name: str,
    seconds: float,
    threads: str,
    images: Float[np.ndarray, "E H W"],
    reference: Float[np.ndarray, "E H W"],
) -> Speed:
    near = float(np.mean(np.abs(images - reference) < 0.01))
    return Speed(name, len(images) / seconds, threads, near)
