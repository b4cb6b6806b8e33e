"""Sliders, buttons and keys that drive the robot and its time."""

import functools
import math
import threading
import time
from collections.abc import Callable

import viser

from cref_jax.live.clock import LEAST, MOST, Clock
from cref_jax.live.session import Session, Wish

FORWARD_STEP, TURN_STEP = 0.05, 0.1  # m/s and rad/s, per press of a key
KEY_PERIOD = 0.08  # s; a key that is held repeats no faster
PUSHES = {  # where a push comes from, and where to, rad to the left of where the robot looks
    "left": -0.5 * math.pi,
    "right": 0.5 * math.pi,
    "behind": 0.0,
    "front": math.pi,
}
KEYS = """\
| | |
|---|---|
| **↑ ↓** | faster, slower |
| **← →** | turn |
| **L** | along the lane again |
| **Space** | stop, walk |
| **R** | reset |
| **P** | pause |
| **N** | single step |
| **B** | push |
"""


class DrivePanel:
    """What is asked of the robot; several viewers share it."""

    def __init__(self, server: viser.ViserServer, session: Session, clock: Clock) -> None:
        self._gui, self._session, self._clock = server.gui, session, clock
        self._lock = threading.Lock()
        self._pressed: dict[str, float] = {}  # s, when each key was last acted on
        with self._gui.add_folder("Drive"):
            self._add_drive()
        with self._gui.add_folder("Push"):
            self._add_push()
        with self._gui.add_folder("Time"):
            self._add_time()
        with self._gui.add_folder("Keys", expand_by_default=False):
            self._gui.add_markdown(KEYS)
        self._add_keys()
        self.set_limits()

    def set_limits(self) -> None:
        """Take the limits of the sliders from the policy's command."""
        limits = self._session.view().stage.policy.manifest["command"]
        sliders = (self._forward, self._sideways, self._turn)
        for slider, low, high in zip(sliders, limits["low"], limits["high"], strict=True):
            slider.min, slider.max = float(low), float(high)

    def refresh(self) -> None:
        """Show what is asked for now, which keys and restarts change as well."""
        wish = self._session.wish
        assert wish.vx is not None
        self._forward.value, self._sideways.value = round(wish.vx, 2), wish.vy
        self._turn.value, self._lane.value = wish.yaw_rate, wish.keep_lane

    def _add_drive(self) -> None:
        add = lambda label, step, hint: self._gui.add_slider(
            label, min=-1.0, max=1.0, step=step, initial_value=0.0, hint=hint
        )
        self._forward = add("Forward", 0.01, "m/s; keys ↑ and ↓")
        self._sideways = add("Left", 0.01, "m/s to the left")
        self._turn = add("Turn", 0.01, "rad/s to the left; keys ← and →")
        self._lane = self._gui.add_checkbox(
            "Along the lane", True, hint="steer as the operator in training does; key L"
        )
        acts = {
            "Stop": self._session.stop,
            "Walk": self._session.walk,
            "Reset": self._session.reset,
        }
        self._add_buttons("Robot", "stand, walk again, or begin anew at the next start", acts)
        for slider in (self._forward, self._sideways):
            slider.on_update(self._on_slider)
        self._turn.on_update(self._on_turn)
        self._lane.on_update(self._on_slider)

    def _add_push(self) -> None:
        self._strength = self._gui.add_slider(
            "Strength", min=0.1, max=2.0, step=0.1, initial_value=0.5,
            hint="m/s, by which the velocity of the base changes at once",
        )  # fmt: skip
        acts = {name: functools.partial(self._push, name) for name in PUSHES}
        self._add_buttons("From", "where the push comes from", acts)

    def _add_time(self) -> None:
        self._speed = self._gui.add_slider(
            "Speed", min=LEAST, max=MOST, step=0.05, initial_value=1.0, hint="of real time"
        )
        pause = lambda paused: lambda: setattr(self._clock, "paused", paused)
        acts = {"Pause": pause(True), "Go on": pause(False), "Step": self._clock.step_once}
        self._add_buttons("Clock", "a step is one of control, 20 ms", acts)
        self._restarts = self._gui.add_checkbox(
            "Begin again", True, hint="two seconds after a fall or the end"
        )
        self._speed.on_update(lambda _: setattr(self._clock, "speed", self._speed.value))
        self._restarts.on_update(lambda _: setattr(self._session, "restarts", self._restarts.value))

    def _add_buttons(self, label: str, hint: str, acts: dict[str, Callable[[], None]]) -> None:
        """Add a row of buttons."""
        group = self._gui.add_button_group(label, tuple(acts), hint=hint)
        group.on_click(lambda _: acts[group.value]())

    def _add_keys(self) -> None:
        forward = lambda step: lambda: self._change(FORWARD_STEP * step, 0.0)
        turn = lambda step: lambda: self._change(0.0, TURN_STEP * step)
        lane = lambda: self._session.drive(
            self._session.wish._replace(keep_lane=True, yaw_rate=0.0)
        )
        keys: list[tuple[viser.HotkeyKey, str, Callable[[], None]]] = [
            ("arrowup", "Faster", forward(1)),
            ("arrowdown", "Slower", forward(-1)),
            ("arrowleft", "Turn left", turn(1)),
            ("arrowright", "Turn right", turn(-1)),
            ("L", "Along the lane", lane),
            ("space", "Stop or walk", self._toggle_stop),
            ("R", "Reset", self._session.reset),
            ("P", "Pause or go on", self._toggle_pause),
            ("N", "Single step", self._clock.step_once),
            ("B", "Push from the left", lambda: self._push("left")),
        ]
        for key, label, act in keys:
            command = self._gui.add_command(label, hotkey=key)
            command.on_trigger(lambda _, key=key, act=act: self._press(key, act))

    def _press(self, key: str, act: Callable[[], None]) -> None:
        """Act on a key, but not on every repeat of one that is held."""
        with self._lock:
            now = time.perf_counter()
            if now - self._pressed.get(key, -math.inf) < KEY_PERIOD:
                return
            self._pressed[key] = now
        act()

    def _change(self, forward: float, turn: float) -> None:
        wish = self._session.wish
        assert wish.vx is not None
        within = lambda slider, value: round(min(max(value, slider.min), slider.max), 3)
        wish = wish._replace(vx=within(self._forward, wish.vx + forward))
        if turn:
            before = 0.0 if wish.keep_lane else wish.yaw_rate
            wish = wish._replace(yaw_rate=within(self._turn, before + turn), keep_lane=False)
        self._session.drive(wish)

    def _on_slider(self, event: viser.GuiEvent) -> None:
        if event.client_id is None:  # set by `refresh`
            return
        wish = self._session.wish
        moved = event.target is self._forward
        self._session.drive(
            Wish(
                vx=self._forward.value if moved else wish.vx,
                vy=self._sideways.value,
                yaw_rate=0.0 if self._lane.value else self._turn.value,
                keep_lane=self._lane.value,
            )
        )

    def _on_turn(self, event: viser.GuiEvent) -> None:
        if event.client_id is None:
            return
        wish = self._session.wish
        self._session.drive(wish._replace(yaw_rate=self._turn.value, keep_lane=False))

    def _toggle_stop(self) -> None:
        (self._session.walk if self._session.is_stopped else self._session.stop)()

    def _toggle_pause(self) -> None:
        self._clock.paused = not self._clock.paused

    def _push(self, origin: str) -> None:
        self._session.push(PUSHES[origin], self._strength.value)
