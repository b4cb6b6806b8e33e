"""Another ground or another policy, without a restart."""

import threading
from collections.abc import Callable
from pathlib import Path

import viser

from cref_jax.errors import CheckpointError, ConfigError
from cref_jax.live import policies
from cref_jax.live.policies import Loaded
from cref_jax.live.session import Session
from cref_jax.live.stage import Place, Stage, StageBuilder
from cref_jax.terrain import generators
from cref_jax.whole_body import scene_files

MAP, SCENE = "height map", "scene"
LANES = tuple(kind for kind in generators.KINDS if kind != "rough")  # it needs too many boxes
SIZES = {  # m, at first; a slope's gradient
    "slope": 0.2, "stairs_up": 0.15, "stairs_down": 0.15, "ascent": 0.15, "descent": 0.15,
    "gap": 0.5, "platform": 0.3,
}  # fmt: skip


class ChoicePanel:
    """Chooses ground and policy; both are loaded while the robot walks on."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        builder: StageBuilder,
        on_changed: Callable[[Stage], None],
    ) -> None:
        self._server, self._gui, self._session, self._builder = server, server.gui, session, builder
        self._on_changed, self._lock = on_changed, threading.Lock()
        stage = session.view().stage
        self._terrain = stage.place.terrain
        with self._gui.add_folder("Ground"):
            self._add_grounds(stage.place)
        with self._gui.add_folder("Policy"):
            self._add_policies(stage.policy)

    def change(self, find: Callable[[Stage], Stage], what: str) -> None:
        """Go to another stage; while it is built, say so, and if that fails, why."""
        with self._lock:
            self._busy.content, self._busy.visible = f"*{what} …*", True
            try:
                stage = find(self._session.view().stage)
                self._session.begin(stage)
                self._on_changed(stage)
            except (ConfigError, CheckpointError, OSError) as error:
                self.complain(str(error))
            finally:
                self._busy.visible = False

    def complain(self, message: str) -> None:
        """Show a mistake to all viewers."""
        for client in self._server.get_clients().values():
            client.add_notification("Not done", message, color="red", auto_close_seconds=10.0)

    def _add_grounds(self, place: Place) -> None:
        scenes = sorted(path.stem for path in scene_files.directory().glob("*.toml"))
        kind = SCENE if place.scene else MAP if place.map else place.kind
        kinds = list(dict.fromkeys([*LANES, kind, SCENE, MAP]))
        self._kind = self._gui.add_dropdown("Kind", kinds, initial_value=kind)
        self._size = self._gui.add_number(
            "Size, cm", round(100.0 * place.size, 1), min=0.0, max=200.0, step=1.0,
            hint="of the obstacles; for a slope its gradient in %",
        )  # fmt: skip
        self._scene = self._gui.add_dropdown(
            "Scene", scenes, initial_value=place.scene or scenes[0]
        )
        self._map = self._gui.add_text("File", str(place.map or ""), hint=".npy, .png or .tif")
        self._go = self._gui.add_button("Go there")
        self._kind.on_update(self._on_kind)
        self._scene.on_update(self._on_scene)
        self._go.on_click(lambda _: self._go_there())
        self._show_fields()

    def _add_policies(self, policy: Loaded) -> None:
        names = list(dict.fromkeys([policy.name, *policies.bundled_names()]))
        self._policy = self._gui.add_dropdown("Take", names, initial_value=policy.name)
        self._source = self._gui.add_text("Folder", "", hint="an exported policy, or runs/NAME")
        self._load = self._gui.add_button("Load the folder")
        self._busy = self._gui.add_markdown("", visible=False)
        self._policy.on_update(self._on_policy)
        self._load.on_click(lambda _: self._take(self._source.value.strip()))

    def _on_kind(self, event: viser.GuiEvent) -> None:
        if event.client_id is None:
            return
        kind = self._kind.value
        self._size.value = 100.0 * SIZES.get(kind, 0.0)
        self._show_fields()
        if kind != MAP:
            self._go_there()

    def _on_scene(self, event: viser.GuiEvent) -> None:
        if event.client_id is not None:
            self._go_there()

    def _on_policy(self, event: viser.GuiEvent) -> None:
        if event.client_id is not None:
            self._take(self._policy.value)

    def _show_fields(self) -> None:
        kind = self._kind.value
        self._size.visible = kind in SIZES
        self._scene.visible, self._map.visible = kind == SCENE, kind == MAP
        self._go.visible = kind in SIZES or kind == MAP

    def _go_there(self) -> None:
        kind, size = self._kind.value, self._size.value / 100.0
        if kind == SCENE:
            place = Place(scene=self._scene.value)
        elif kind == MAP:
            place = Place(map=Path(self._map.value.strip()))
        else:
            place = Place(kind, size, self._terrain)
        self.change(lambda stage: self._builder.build(stage.policy, place), "building the ground")

    def _take(self, source: str) -> None:
        def find(stage: Stage) -> Stage:
            policy = policies.load(Path(source))
            if policy.name not in self._policy.options:
                self._policy.options = (*self._policy.options, policy.name)
            self._policy.value = policy.name
            return self._builder.build(policy, stage.place)

        if source:
            self.change(find, f"loading {source}")
