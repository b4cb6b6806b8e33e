"""Depth frames: holes are filled in, and every pixel takes the nearest depth around it."""

from __future__ import annotations

import numpy as np


def fill_holes(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Interpolate an image [H, W] linearly between known pixels: along rows, then columns."""
    row, column, lines = np.arange(len(values)), np.arange(values.shape[1]), values.copy()
    some = np.flatnonzero(known.any(axis=1))
    for i in some:
        lines[i] = np.interp(column, column[known[i]], values[i, known[i]])
    return np.stack([np.interp(row, some, lines[some, j]) for j in column], axis=1)


def nearest_around(image: np.ndarray, window: int) -> np.ndarray:
    """Compute the minimum of the window x window values around each pixel, fewer at the borders."""
    reach, (rows, columns) = window // 2, image.shape
    wide = np.pad(image, reach, constant_values=np.inf)
    lines = np.minimum.reduce([wide[k : k + rows] for k in range(window)])
    return np.minimum.reduce([lines[:, k : k + columns] for k in range(window)])
