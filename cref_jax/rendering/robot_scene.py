"""A MuJoCo model for rendering the whole robot on its lane.

The lane is a slab on a plain. Columns of equal height are merged into boxes of two alternating
tones, to make motion visible: the tone changes with each tread and each metre. Terrain that would
need too many boxes, such as slopes and noise, becomes a height field through the column centres.
"""

import mujoco
import numpy as np
from jaxtyping import Float

from cref_jax import config, geoms, robot
from cref_jax.errors import ConfigError
from cref_jax.geoms import GROUND, TILE, TONES, Boxes
from cref_jax.rendering.video import Frame
from cref_jax.robot.registry import describe
from cref_jax.system import startup
from cref_jax.terrain import Terrain

MOST_VERTICES = 1_000_000  # of a height field; more render too slowly on a CPU
BASE = 0.1  # m, from the plain to the lowest column
PLAIN = (0.66, 0.72, 0.78)
SKY = ((0.30, 0.50, 0.75), (0.88, 0.91, 0.94))  # at the zenith, at the horizon

MARKS = ((0.95, 0.45, 0.10, 1.0), (0.10, 0.65, 0.30, 1.0))  # colours for the left and right foot
MARK_RADIUS = 0.015  # m
NO_MARKS = np.zeros((0, 0, 3))

AZIMUTH = 100.0  # deg, of the view: the robot walks to the right and slightly nearer
ELEVATION = -14.0  # deg
DISTANCE = 4.0  # m, from the camera to the pelvis
VIEW = 32.0  # deg, vertical field of view
CALM = 1.0  # s, averaging window of the camera path


def build(
    moves: robot.Actuated,
    physics: config.Physics,
    ground: Terrain,
    name: str | None = None,
) -> mujoco.MjModel:
    """Build the model to render; qpos is that of the physics, x and y are those of `ground`."""
    heights, origin = window(ground)
    spec = build_stage(moves, physics, float(heights.min()) - BASE, name)
    boxes = geoms.merge_boxes(heights, max(1, round(TILE / ground.cell)))
    if boxes is None:
        _add_height_field(spec, heights, origin, ground.cell)
    else:
        _add_boxes(spec, boxes, origin, ground.cell)
    return spec.compile()


def build_stage(
    moves: robot.Actuated, physics: config.Physics, z: float, name: str | None = None
) -> mujoco.MjSpec:
    """Build the spec of the robot with lights, above an infinite plain at height z, m."""
    spec = robot.spec(moves, physics, contact_planes=0, visual=True, name=name)
    _add_light(spec, describe(name).base)
    _add_plain(spec, z)
    return spec


def window(ground: Terrain) -> tuple[Float[np.ndarray, "X Y"], Float[np.ndarray, "2"]]:
    """Return the column heights of the terrain's window and the window's lower corner, m."""
    return ground.heights, np.asarray(ground.origin)


class Canvas:
    """An offscreen renderer of one model."""

    def __init__(
        self,
        model: mujoco.MjModel,
        width: int,
        height: int,
        azimuth: float = AZIMUTH,
        elevation: float = ELEVATION,
    ) -> None:
        """Create the renderer; the camera looks along azimuth and elevation, deg.

        Raises:
            ConfigError: OpenGL is not available.
        """
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._model, self._data = model, mujoco.MjData(model)
        self._camera = mujoco.MjvCamera()
        self._camera.azimuth, self._camera.elevation = azimuth, elevation
        self._camera.distance = DISTANCE
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # the types depend on the backend
            asked = startup.missing_opengl
            raise ConfigError(
                (f"MUJOCO_GL={asked}, which is not installed: " if asked else "")
                + "rendering needs OpenGL; on Debian and Ubuntu: "
                "apt install libegl1 libosmesa6 libgl1; if DISPLAY is set without a display: "
                "MUJOCO_GL=egl"
            ) from error

    def __enter__(self) -> "Canvas":
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def draw(
        self,
        qpos: Float[np.ndarray, " Q"],
        look_at: Float[np.ndarray, "3"],
        marks: Float[np.ndarray, "F K 3"] = NO_MARKS,
    ) -> Frame:
        """Render the robot in this pose with the camera pointed at `look_at`, m.

        `marks` are points to draw, m, in one colour per foot; NaN points are skipped.
        """
        self._data.qpos[:] = qpos
        mujoco.mj_forward(self._model, self._data)
        self._camera.lookat[:] = look_at
        self._renderer.update_scene(self._data, self._camera)
        for points, colour in zip(marks, MARKS, strict=False):
            for point in points[np.isfinite(points).all(axis=-1)]:
                self._add_mark(point, colour)
        return self._renderer.render()

    def _add_mark(self, point: Float[np.ndarray, "3"], colour: tuple[float, ...]) -> None:
        """Add a sphere to the scene before it is rendered."""
        scene = self._renderer.scene
        size, straight = np.full(3, MARK_RADIUS), np.eye(3).ravel()
        ball = mujoco.mjtGeom.mjGEOM_SPHERE
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom], ball, size, point, straight, np.array(colour, np.float32)
        )
        scene.ngeom += 1


def camera_path(qpos: Float[np.ndarray, "T Q"], period: float) -> Float[np.ndarray, "T 3"]:
    """Compute the points to look at, m: the pelvis path averaged over `CALM` around each pose.

    `period` is the time between poses, s. Both ends are extended by point reflection, so that a
    straight path is unchanged.
    """
    path = qpos[:, :3]
    half = min(round(0.5 * CALM / period), len(path) - 1)
    weights = np.hanning(2 * half + 3)[1:-1]
    before = 2.0 * path[:1] - path[half:0:-1]
    after = 2.0 * path[-1:] - path[-2 : -2 - half : -1]
    extended = np.concatenate([before, path, after])
    averaged = [np.convolve(axis, weights / weights.sum(), mode="valid") for axis in extended.T]
    return np.stack(averaged, axis=1)


def _add_boxes(
    spec: mujoco.MjSpec, boxes: Boxes, origin: Float[np.ndarray, "2"], cell: float
) -> None:
    """Add one geom per box, each resting on the plain."""
    bottom = boxes.height.min() - BASE
    for first, size, height, tone in zip(*boxes, strict=True):
        half = 0.5 * (height - bottom)
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[*(origin + (first + 0.5 * size) * cell), height - half],
            size=[*(0.5 * size * cell), half],
            rgba=[*TONES[tone], 1.0],
            contype=0,
            conaffinity=0,
            group=GROUND,
        )


def _add_height_field(
    spec: mujoco.MjSpec,
    heights: Float[np.ndarray, "X Y"],
    origin: Float[np.ndarray, "2"],
    cell: float,
) -> None:
    """Add a height field through the column centres, subsampled on a huge map."""
    step = int(np.ceil(np.sqrt(heights.size / MOST_VERTICES)))
    heights = heights[::step, ::step]
    low, rise = float(heights.min()), float(np.ptp(heights))
    extent = (np.array(heights.shape) - 1) * step * cell
    spec.add_hfield(
        name="lane",
        nrow=heights.shape[1],  # along y
        ncol=heights.shape[0],
        size=[*(0.5 * extent), max(rise, 1e-3), BASE],
        userdata=((heights - low) / max(rise, 1e-3)).T.ravel(),
    )
    geoms.add_checker(spec, "lane", TONES, repeat=0.5 / TILE)
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="lane",
        material="lane",
        pos=[*(origin + 0.5 * (cell + extent)), low],
        contype=0,
        conaffinity=0,
        group=GROUND,
    )


def _add_plain(spec: mujoco.MjSpec, z: float) -> None:
    """Add an infinite plane under the lane that haze blends into the sky."""
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[0.0, 0.0, z],
        size=[0.0, 0.0, 1.0],  # unbounded
        rgba=[*PLAIN, 1.0],
        contype=0,
        conaffinity=0,
        group=GROUND,
    )


def _add_light(spec: mujoco.MjSpec, base: str) -> None:
    """Add the sky, ambient light and a shadow-casting sun that follows the robot."""
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=SKY[0],
        rgb2=SKY[1],
        width=256,
        height=1536,
    )
    spec.body(base).add_light(
        pos=[-1.5, -2.5, 5.0],
        dir=[0.3, 0.5, -1.0],
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK,
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.62, 0.60, 0.56],
        specular=[0.2, 0.2, 0.2],
        castshadow=True,
    )
    visual = spec.visual
    visual.headlight.ambient = [0.42, 0.43, 0.45]
    visual.headlight.diffuse = [0.18, 0.18, 0.18]
    visual.headlight.specular = [0.0, 0.0, 0.0]
    visual.rgba.haze = [*SKY[1], 1.0]
    visual.global_.fovy = VIEW
    visual.quality.shadowsize = 2048
    visual.map.shadowclip = 1.5  # of the extent: half the side of the shadowed square
    visual.map.haze = 0.6
    visual.map.zfar = 50.0  # of the extent
    spec.stat.extent = 2.0  # m
