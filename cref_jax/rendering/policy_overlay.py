"""A panel with the policy's depth image, attention and highway gate, beside the scene view."""

from typing import NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont, ImageOps

WIDTH = 320  # pixels
SECONDS = 4.0  # length of the gate history shown
DEPTHS = "turbo_r"  # matplotlib colour map, near to far
INK, PAPER, FAINT = (40, 40, 44), (250, 250, 248), (205, 205, 205)
BAND, LINE = (190, 210, 235), (30, 90, 170)
MARGIN = 12  # pixels
TITLE = 20  # pixels, height of a line of text

Picture = UInt8[np.ndarray, "height width 3"]


class PolicyView(NamedTuple):
    """The policy's perception and gate up to one moment."""

    depth: Float[np.ndarray, "H W"] | None  # D, normalised; None before the first frame
    attention: Float[np.ndarray, " N"] | None  # weights of the tokens, mean over the heads
    gates: Float[np.ndarray, "t D"]  # beta of each step so far


def draw(view: PolicyView, height: int, d_max: float, period: float, sees: bool) -> Picture:
    """Draw the panel, `height` pixels high; `period` is the time between rows of the gates, s.

    For a blind policy (`sees` is False) only the gate is drawn.
    """
    picture = Image.new("RGB", (WIDTH, height), PAPER)
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(13)
    inner, top = WIDTH - 2 * MARGIN, MARGIN
    if sees:
        pen.text((MARGIN, top), f"depth, 0 to {d_max:g} m (near is red)", INK, font)
        size = (inner, inner * 3 // 4)
        picture.paste(colour_depth(view.depth, size), (MARGIN, top + TITLE))
        top += TITLE + size[1] + MARGIN
        pen.text((MARGIN, top), "attention, mean over heads", INK, font)
        size = (inner // 2, inner * 3 // 8)
        picture.paste(_attention_image(view, size), (MARGIN, top + TITLE))
        top += TITLE + size[1] + MARGIN
    pen.text((MARGIN, top), "highway gate (1: memory)", INK, font)
    draw_gate(pen, view.gates, (MARGIN, top + TITLE, WIDTH - MARGIN, height - MARGIN), period)
    return np.asarray(picture)


def colour_depth(depth: Float[np.ndarray, "H W"] | None, size: tuple[int, int]) -> Image.Image:
    """Draw a depth image, normalised, `size` pixels wide and high; grey where there is none.

    It keeps its proportions; what remains beside it is grey, too.
    """
    if depth is None:
        return Image.new("RGB", size, FAINT)
    colours = matplotlib.colormaps[DEPTHS](np.clip(depth + 0.5, 0.0, 1.0), bytes=True)
    return _fit(colours, size)


def _attention_image(view: PolicyView, size: tuple[int, int]) -> Image.Image:
    """Draw the token weights at their image positions, scaled to the largest.

    A token is of as many pixels down as across, so their grid has the proportions of the image.
    """
    if view.depth is None or view.attention is None:
        return Image.new("RGB", size, FAINT)
    height, width = view.depth.shape
    rows = round((len(view.attention) * height / width) ** 0.5)
    grid = (view.attention / view.attention.max()).reshape(rows, -1)
    return _fit(matplotlib.colormaps["magma"](grid, bytes=True), size)


def _fit(colours: UInt8[np.ndarray, "h w 4"], size: tuple[int, int]) -> Image.Image:
    """Enlarge an image into `size`, wide and high, pixel by pixel."""
    image = Image.fromarray(colours[..., :3])
    return ImageOps.pad(image, size, Image.Resampling.NEAREST, FAINT)


def draw_gate(
    pen: ImageDraw.ImageDraw,
    gates: Float[np.ndarray, "t D"],
    box: tuple[int, int, int, int],
    period: float,
) -> None:
    """Draw the mean of the gate channels and the band from the 10th to the 90th percentile."""
    left, top, right, bottom = box
    shown = gates[-max(2, round(SECONDS / period)) :]
    span = max(1, round(SECONDS / period) - 1)
    x = right - (right - left) * (len(shown) - 1 - np.arange(len(shown))) / span
    y = lambda value: bottom - (bottom - top) * value
    low, high = np.percentile(shown, (10, 90), axis=1)
    for value in (0.0, 0.5, 1.0):
        pen.line([(left, y(value)), (right, y(value))], FAINT)
    if len(shown) > 1:
        edge = [*zip(x, y(high), strict=True), *zip(x[::-1], y(low[::-1]), strict=True)]
        pen.polygon(edge, BAND)
        pen.line([*zip(x, y(shown.mean(axis=1)), strict=True)], LINE, width=2)
