import numpy as np
from PIL import Image

from cref_jax import terrain
from cref_jax.rendering import map_plot


def test_the_picture_of_a_map_marks_the_start_in_red(tmp_path):
    ground = terrain.from_heights(np.linspace(0.0, 1.0, 4000).reshape(100, 40), 0.1, (-1.0, -2.0))
    map_plot.draw_map(ground, tmp_path / "map.png")
    picture = np.asarray(Image.open(tmp_path / "map.png").convert("RGB")).astype(int)
    red = (picture[..., 0] > 240) & (picture[..., 1] < 30) & (picture[..., 2] < 30)
    across = np.flatnonzero(red.any(axis=0)) / picture.shape[1]
    # of 10 m shown, the start is 1.75 m from the left, and the arrow 1 m long
    assert 0.15 < across.min() < 0.3 and red.sum() > 100
