"""The panel with the policy's depth image, attention and gate."""

import numpy as np

from cref_jax.rendering import policy_overlay
from cref_jax.rendering.policy_overlay import PolicyView

PERIOD = 0.02  # s
HEIGHT = 540


def draw(view, sees=True):
    return policy_overlay.draw(view, HEIGHT, d_max=3.0, period=PERIOD, sees=sees)


def some_view(**changes):
    gates = np.tile(np.linspace(0.2, 0.8, 16), (50, 1))
    view = PolicyView(np.zeros((48, 64)), np.full(48, 1 / 48), gates)
    return view._replace(**changes)


def test_it_has_the_height_of_the_picture_beside_it():
    for sees in (True, False):
        assert draw(some_view(), sees).shape == (HEIGHT, policy_overlay.WIDTH, 3)
    assert draw(some_view()).dtype == np.uint8


def test_near_is_red_and_far_is_blue():
    depth = np.full((48, 64), 0.5)  # d_max
    depth[:, :32] = -0.4  # 0.3 m
    image = draw(some_view(depth=depth)).astype(int)
    row = image[150, policy_overlay.MARGIN + 5 : policy_overlay.WIDTH - policy_overlay.MARGIN - 5]
    near, far = row[20], row[-20]
    assert near[0] > 2 * near[2] and far[2] > far[0]


def test_each_part_shows_what_it_is_given():
    base = draw(some_view())
    weights = np.zeros(48)
    weights[5] = 1.0
    changed = {
        "depth": draw(some_view(depth=np.full((48, 64), -0.3))),
        "attention": draw(some_view(attention=weights)),
        "gates": draw(some_view(gates=np.full((50, 16), 0.1))),
    }
    rows = {
        name: np.flatnonzero((image != base).any(axis=(1, 2))) for name, image in changed.items()
    }
    assert rows["depth"].max() < rows["attention"].min()
    assert rows["attention"].max() < rows["gates"].min()


def test_the_attention_is_where_its_token_is_in_an_image_of_any_shape():
    # 64 x 64 pixels in tokens of 8 x 8 are 8 x 8 tokens; the tenth is the second of the second row
    weights = np.zeros(64)
    weights[9] = 1.0
    image = draw(some_view(depth=np.zeros((64, 64)), attention=weights)).astype(int)
    wide, high = 148, 111  # pixels of the picture of the attention
    top, left = 12 + 20 + 222 + 12 + 20, 12
    part = image[top : top + high, left : left + wide].sum(axis=2)
    down, across = np.nonzero(part == part.max())
    np.testing.assert_allclose(down.mean() / high, 1.5 / 8, atol=0.02)
    # 111 pixels wide, too, in the middle of 148
    np.testing.assert_allclose((across.mean() - 18.5) / high, 1.5 / 8, atol=0.02)


def test_depth_keeps_its_proportions():
    whole = policy_overlay.colour_depth(np.zeros((48, 64)), (296, 222))
    assert not (np.asarray(whole) == policy_overlay.FAINT).all(axis=2).any()
    square = np.asarray(policy_overlay.colour_depth(np.zeros((64, 64)), (296, 222)))
    beside = (square == policy_overlay.FAINT).all(axis=2)
    assert square.shape == (222, 296, 3)
    assert beside[:, :37].all() and beside[:, -37:].all() and not beside[:, 37:-37].any()


def test_before_the_first_frame_it_is_grey_and_does_not_fail():
    image = draw(PolicyView(None, None, np.full((1, 16), 0.5)))
    assert (image[100, 100] == policy_overlay.FAINT).all()
