"""What the policy sees and does, beside the scene."""

import html

import numpy as np
import viser

from cref_jax.live import sight_picture
from cref_jax.live.clock import Clock
from cref_jax.live.session import View
from cref_jax.rendering.robot_scene import MARKS

QUALITY = 80  # of its JPEG

ROW = "<tr><td style='opacity:.6;padding-right:.8em'>{}</td><td>{}</td></tr>"
TABLE = "<table style='font-size:.82em;line-height:1.5;margin:.2em .6em'>{}</table>"


class SightPanel:
    """A column with the depth image, the attention, the gate, and the robot's state in words."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.panel = server.gui.add_panel()
        with self.panel.add_tab("What it sees", viser.Icon.EYE):
            self._words = server.gui.add_html("")
            blank = np.full((sight_picture.HEIGHT, sight_picture.WIDTH, 3), 255, np.uint8)
            self._picture = server.gui.add_image(blank, format="jpeg", jpeg_quality=QUALITY)
            self._said = ""
        self.panel.dock_left()
        self.panel.set_width(sight_picture.WIDTH + 24)

    def draw_picture(self, view: View) -> None:
        """Draw depth, attention and gate."""
        self._picture.image = sight_picture.draw_sight(view)

    def write(self, view: View, clock: Clock) -> None:
        """Write speeds, time and status."""
        forward, left, turn = view.command
        policy = view.stage.policy
        rows = {
            "On": view.stage.place.title(),
            "Policy": ", ".join(filter(None, (policy.name, policy.detail))),
            "Forward": f"{view.velocity[0]:.2f} of {forward:.2f} m/s",
            "Left": f"{view.velocity[1]:.2f} of {left:.2f} m/s",
            "Turn": f"{view.yaw_rate:.2f} of {turn:.2f} rad/s",
            "Time": f"{view.seconds:.2f} s, {_describe_pace(clock)}",
            "Runtime": view.why or "all is well",
            "Robot": str(
                clock.failure
                or view.note
                or ("told to stand" if view.is_stopped else "on its feet")
            ),
        }
        said = "".join(ROW.format(key, html.escape(value)) for key, value in rows.items())
        said = TABLE.format(said) + _legend()
        if said != self._said:
            self._said = self._words.content = said


def _describe_pace(clock: Clock) -> str:
    """Say how fast time passes, as measured."""
    return "paused" if clock.paused else f"{clock.share:.2f} of real time"


def _legend() -> str:
    """Say what the marks on the ground mean."""
    dot = "<span style='color:rgb({},{},{})'>●</span> {}"
    feet = zip(MARKS, ("left foot", "right foot"), strict=True)
    parts = [dot.format(*(round(255 * x) for x in colour[:3]), name) for colour, name in feet]
    return (
        "<div style='font-size:.82em;margin:.2em .6em'>"
        + "&nbsp; ".join(parts)
        + "; bars: where it may step</div>"
    )
