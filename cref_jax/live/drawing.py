"""The scene in the browser: ground, robot, where its feet were and where they may step.

The ground moves below a robot that stays where it is, so that every viewer's own camera follows it.
"""

import time
from typing import NamedTuple

import numpy as np
import trimesh
import viser
from jaxtyping import UInt8

from cref_jax import robot
from cref_jax.live import ground_mesh, robot_mesh
from cref_jax.live.feet import SHOWN
from cref_jax.live.foothold_search import FootholdSearch
from cref_jax.live.matte import make_matte
from cref_jax.live.session import View
from cref_jax.live.stage import Stage
from cref_jax.rendering.robot_scene import MARKS
from cref_jax.whole_body.ground import Lane

FOLLOW = 0.4  # s, in which the camera catches up with the robot
CALM = 0.6  # s, the same upwards
LOOK_UP = 0.05  # m, from the pelvis to the middle of the picture
DISC = 0.035  # m, radius of a touchdown's mark
DOT = 0.02  # m, size of a candidate's mark
ABOVE = np.array([0.0, 0.0, 0.006])  # m, marks above the ground
AWAY = np.array([0.0, 0.0, -1000.0])  # m, where marks without a place are
BESIDE, BEHIND = (-2.3, -2.6, 1.0), (-3.3, -0.9, 1.5)  # m, of a viewer; a scene may have walls
SKY = (226, 232, 239)
SHADOW = 0.35  # darkness of shadows on the ground
GAMMA = 2.2  # of a lit surface's colour, which is linear


class _Body(NamedTuple):
    handle: viser.GlbHandle
    number: int


class Drawing:
    """Draws what a session shows for all viewers; use it from one thread."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._scene = server, server.scene
        self._stage: Stage | None = None
        self._episode = -1
        self._bodies: list[_Body] = []
        self._focus, self._drawn_at = np.zeros(3), time.perf_counter()
        self._marked = -1
        self._set_light()
        self._world = self._scene.add_frame("/world", show_axes=False)
        self._discs = self._add_discs()
        self._dots = self._scene.add_point_cloud(
            "/world/candidates", np.tile(AWAY, (2, 1)), np.zeros((2, 3), np.uint8),
            point_size=DOT, point_shape="circle", point_shading="flat", precision="float32",
        )  # fmt: skip

    def draw(self, view: View) -> None:
        """Show a moment."""
        if view.stage is not self._stage:
            self._set_stage(view.stage)
        with self._server.atomic():
            self._move(view)
            self._mark_touchdowns(view)
        self._server.flush()

    def draw_candidates(self, view: View) -> None:
        """Show where each foot may step; it takes longer than the rest."""
        if self._search is None:
            return
        points, feet = self._search.find(view)
        if len(points) == 0:
            points, feet = AWAY[None], np.zeros(1, int)
        self._dots.points = (points + ABOVE).astype(np.float32)
        self._dots.colors = _colours()[feet]

    def _set_stage(self, stage: Stage) -> None:
        """Replace ground and robot."""
        mesh = make_matte(ground_mesh.build_mesh(stage.ground))
        self._scene.add_mesh_trimesh(
            "/world/ground", mesh, cast_shadow=False, receive_shadow=SHADOW
        )
        is_lane = isinstance(stage.ground, Lane)
        self._server.initial_camera.position = BESIDE if is_lane else BEHIND
        self._search = FootholdSearch.on(stage)
        self._dots.points = np.tile(AWAY, (2, 1)).astype(np.float32)
        if self._stage is None or self._stage.policy.config.robot != stage.policy.config.robot:
            for body in self._bodies:
                body.handle.remove()
            self._bodies = self._add_robot(stage)
        self._stage = stage

    def _move(self, view: View) -> None:
        """Move the robot over the ground, and the ground below the camera."""
        now = time.perf_counter()
        passed, self._drawn_at = now - self._drawn_at, now
        target = view.body_position[1] + [0.0, 0.0, LOOK_UP]
        if view.episode != self._episode:
            self._episode, self._focus, self._marked = view.episode, target, -1
        share = 1.0 - np.exp(-passed / np.array([FOLLOW, FOLLOW, CALM]))
        self._focus = self._focus + share * (target - self._focus)
        self._world.position = -self._focus
        for handle, number in self._bodies:
            handle.position = view.body_position[number]
            handle.wxyz = view.body_rotation[number]

    def _mark_touchdowns(self, view: View) -> None:
        newest = view.touchdowns[-1][1].sum() if view.touchdowns else 0.0
        if newest == self._marked:
            return
        self._marked = newest
        places, colours = np.tile(AWAY, (SHOWN, 1)), np.zeros((SHOWN, 3), np.uint8)
        lit = np.round(255.0 * (_colours() / 255.0) ** GAMMA)
        for i, (foot, at) in enumerate(view.touchdowns):
            places[i], colours[i] = at + ABOVE, lit[foot]
        self._discs.batched_positions = places.astype(np.float32)
        self._discs.batched_colors = colours

    def _add_robot(self, stage: Stage) -> list[_Body]:
        c = stage.body.config
        model = robot.spec("all", c.physics, 0, visual=True, name=c.robot.name).compile()
        return [
            _Body(
                self._scene.add_mesh_trimesh(
                    f"/world/robot/{body}", make_matte(mesh, is_smooth=True)
                ),
                body,
            )
            for body, mesh in robot_mesh.build_links(model).items()
        ]

    def _add_discs(self) -> viser.BatchedMeshHandle:
        disc = trimesh.creation.cylinder(DISC, 0.004, sections=24)
        return self._scene.add_batched_meshes_simple(
            "/world/touchdowns", disc.vertices, disc.faces,
            np.tile([1.0, 0.0, 0.0, 0.0], (SHOWN, 1)), np.tile(AWAY, (SHOWN, 1)),
            batched_colors=np.zeros((SHOWN, 3), np.uint8), cast_shadow=False, lod="off",
        )  # fmt: skip

    def _set_light(self) -> None:
        """Set sky, haze, light and the view that a new viewer begins with."""
        camera = self._server.initial_camera
        camera.position, camera.look_at = BESIDE, (0.35, 0.0, -0.12)
        camera.fov, camera.near = np.deg2rad(45.0), 0.1
        self._scene.set_background_image(np.tile(np.uint8(SKY), (2, 2, 1)))
        self._scene.configure_fog(9.0, 26.0, color=SKY)
        self._scene.configure_default_lights(False)  # several maps of shadows: slow without a GPU
        self._scene.add_light_ambient("/light/sky", intensity=1.1)
        self._scene.add_light_directional(
            "/light/sun", intensity=1.7, cast_shadow=True, position=(-1.5, -2.5, 4.0)
        )


def _colours() -> UInt8[np.ndarray, "2 3"]:
    """Return the colours of the left and the right foot, 0 to 255."""
    return np.round(255.0 * np.array(MARKS)[:, :3]).astype(np.uint8)
