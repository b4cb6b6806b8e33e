"""What the policy sees, what of it it attends to, and its gate, as one picture."""

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont, ImageOps

from cref_jax.live.session import View
from cref_jax.rendering import policy_overlay
from cref_jax.rendering.policy_overlay import FAINT, INK, TITLE

WIDTH = 320  # pixels
PAPER = (255, 255, 255)
GLOW = (255, 110, 20)  # of what the policy attends to most
GAP = 12  # pixels, between the parts
WHOLE, HALF = (WIDTH, WIDTH * 3 // 4), ((WIDTH - GAP) // 2, (WIDTH - GAP) * 3 // 8)  # pixels
HEIGHT = TITLE + WHOLE[1] + GAP + TITLE + HALF[1]


def draw_sight(view: View) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the depth image, and below it the attention over it and the gate."""
    c = view.stage.body.config
    picture = Image.new("RGB", (WIDTH, HEIGHT), PAPER)
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(12)
    depth = None if view.frame is None else np.minimum(view.frame / c.camera.d_max, 1.0) - 0.5
    pen.text((0, 0), f"Depth, 0 to {c.camera.d_max:g} m; near is red", INK, font)
    picture.paste(policy_overlay.colour_depth(depth, WHOLE), (0, TITLE))
    top, right = TITLE + WHOLE[1] + GAP, WIDTH - HALF[0]
    pen.text((0, top), "What it attends to", INK, font)
    picture.paste(_spotlight(depth, view.attention, HALF), (0, top + TITLE))
    pen.text((right, top), "Gate; 1: memory", INK, font)
    box = (right, top + TITLE + 1, WIDTH - 1, HEIGHT - 2)
    policy_overlay.draw_gate(pen, view.gates, box, c.physics.control_period)
    return np.asarray(picture)


def _spotlight(
    depth: Float[np.ndarray, "H W"] | None,
    attention: Float[np.ndarray, " N"] | None,
    size: tuple[int, int],
) -> Image.Image:
    """Draw the depth image in grey, and glowing where the policy attends to it."""
    if depth is None or attention is None:
        return Image.new("RGB", size, FAINT)
    height, width = depth.shape
    rows = round((len(attention) * height / width) ** 0.5)
    weight = (attention / attention.max()).reshape(rows, -1)
    scale = min(size[0] / width, size[1] / height)
    inner = round(scale * width), round(scale * height)
    share = _resize(weight, inner)[..., None]
    grey = 40.0 + 200.0 * _resize(0.5 - depth, inner)[..., None]  # near is light
    mixed = (1.0 - share) * grey + share * np.array(GLOW)
    image = Image.fromarray(np.clip(mixed, 0, 255).astype(np.uint8))
    return ImageOps.pad(image, size, color=FAINT)


def _resize(values: Float[np.ndarray, "h w"], size: tuple[int, int]) -> Float[np.ndarray, "H W"]:
    image = Image.fromarray(values.astype(np.float32))
    return np.asarray(image.resize(size, Image.Resampling.BILINEAR))
