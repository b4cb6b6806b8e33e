"""Gaits, touchdowns and films of a record made by hand stand on the page."""

import matplotlib.colors
import numpy as np
import pytest
from html_reader import leaves, read
from matplotlib.figure import Figure

from cref_jax.pages import evaluation_page, markup, walk_pictures
from cref_jax.rendering import robot_scene

GAIT = [
    {
        "lane": "ascent",
        "size_m": 0.15,
        "seconds": 2.0,
        "stride_s": 0.84,
        "airborne": [0.312, 0.487],
        "contacts": [[[0.0, 0.5], [0.9, 1.4]], [[0.4, 1.0]]],
    },
    {
        "lane": "flat",
        "seconds": 2.0,
        "stride_s": None,
        "airborne": [0.0, 0.0],
        "contacts": [[[0.0, 2.0]], [[0.0, 2.0]]],
    },
]


def group(way, size, foot, count, median, mad, bins):
    return {
        "way": way, "size_m": size, "foot": foot, "touchdowns": count,
        "median_m": median, "mad_m": mad, "bins": bins,
    }  # fmt: skip


TOUCHDOWNS = {  # bins of 10 cm from -10 to 40 cm
    "tread_m": 0.3,
    "bin_m": 0.1,
    "first_m": -0.1,
    "groups": [
        group("up", 0.1, "left", 3, 0.123, 0.014, [0, 1, 2, 0, 0]),
        group("up", 0.1, "right", 0, None, None, [0, 0, 0, 0, 0]),
        group("up", 0.1, "both", 3, 0.123, 0.014, [0, 1, 2, 0, 0]),
        group("up", 0.2, "left", 2, 0.21, 0.0, [0, 0, 0, 2, 0]),
        group("up", 0.2, "right", 5, 0.05, 0.02, [0, 5, 0, 0, 0]),
        group("up", 0.2, "both", 7, 0.06, 0.021, [0, 5, 0, 2, 0]),
        group("down", 0.2, "left", 0, None, None, [0, 0, 0, 0, 0]),
        group("down", 0.2, "right", 1, -0.061, 0.0, [1, 0, 0, 0, 0]),
        group("down", 0.2, "both", 1, -0.061, 0.0, [1, 0, 0, 0, 0]),
    ],
}
FILM = {
    "kind": "stairs", "level": "ood", "size_m": 0.23, "lane": "descent", "failures": 17,
    "trial": 3, "ending": "tilted", "seconds": 7.22,
}  # fmt: skip


def written(record, tmp_path):
    evaluation_page.write(record, tmp_path / "eval.html")
    return read(tmp_path / "eval.html")


@pytest.fixture
def painted(monkeypatch):
    """Return the axes of each chart that is drawn from here on."""
    axes = []

    def chart(paint, *_, **__):
        axes.append(Figure().subplots())
        paint(axes[-1])
        return markup.Html()

    monkeypatch.setattr(markup, "chart", chart)
    return axes


def test_every_number_of_gaits_and_touchdowns_is_shown(tmp_path):
    seen = written({"suite": "table", "gait": GAIT, "touchdowns": TOUCHDOWNS}, tmp_path)
    assert leaves(seen) == [] and seen.tags.count("img") == 3
    assert ["flight up 15 cm", "0.84 s", "31 %", "49 %"] in seen.rows
    assert ["flat", "-", "0 %", "0 %"] in seen.rows
    small, hard, down = (row for row in seen.rows if row[0].endswith(("10 cm", "20 cm")))
    assert small == [
        "up, 10 cm", "3", "0", "3", "12.3 cm", "-", "12.3 cm", "1.4 cm", "-", "1.4 cm"
    ]  # fmt: skip
    assert hard == [
        "up, 20 cm", "2", "5", "7", "21.0 cm", "5.0 cm", "6.0 cm", "0.0 cm", "2.0 cm", "2.1 cm"
    ]  # fmt: skip
    assert down[0] == "down, 20 cm" and down[4:7] == ["-", "-6.1 cm", "-6.1 cm"]


def test_a_bar_lasts_as_long_as_a_foot_is_down(painted):
    walk_pictures.gait_chart(GAIT)
    (axis,) = painted
    spans = [[p.get_extents().intervalx for p in bars.get_paths()] for bars in axis.collections]
    expected = [[(0.0, 0.5), (0.9, 1.4)], [(0.4, 1.0)], [(0.0, 2.0)], [(0.0, 2.0)]]
    for found, wanted in zip(spans, expected, strict=True):
        np.testing.assert_allclose(found, wanted)
    assert axis.get_xlabel() == "time, s"


def test_the_histogram_pools_the_sizes_and_tells_the_feet_apart(painted):
    walk_pictures.touchdown_chart(TOUCHDOWNS, "up")
    (axis,) = painted
    # 10 touchdowns: left 1, 2, 2 and right 5 in the bins from 0, 10 and 20 cm; right on top
    left, right = axis.containers
    np.testing.assert_allclose([bar.get_height() for bar in left], [0, 10, 20, 20, 0])
    np.testing.assert_allclose([bar.get_height() for bar in right], [0, 50, 0, 0, 0])
    assert right[1].get_y() == 10 and left[1].get_x() == pytest.approx(0.0, abs=1e-9)
    assert axis.get_title() == "up the stairs, 10 touchdowns"
    assert axis.get_xlabel() == "from the nosing towards the riser, cm"


def test_the_feet_have_the_colours_of_the_films():
    marks = [matplotlib.colors.to_hex(mark[:3]) for mark in robot_scene.MARKS]
    assert list(walk_pictures.FEET.values()) == marks


def test_a_film_is_inside_the_page_and_says_what_went_wrong(tmp_path):
    (tmp_path / "films").mkdir()
    (tmp_path / "films" / "a.mp4").write_bytes(b"\0\0\0\x18ftypisom")
    seen = written({"suite": "table", "films": [FILM | {"file": "films/a.mp4"}]}, tmp_path)
    assert "stairs ood, 23 cm, flight down: the first of 17 failures, tilted too far" in seen.text
    assert "after 7.2 s" in seen.text
    assert [r for r in seen.references if r.startswith("data:video/mp4")]


def test_a_page_without_opengl_says_why(tmp_path):
    why = "rendering needs OpenGL; on Debian and Ubuntu: apt install libegl1"
    seen = written({"suite": "table", "films": [FILM | {"why": why}]}, tmp_path)
    assert f"No film: {why}" in seen.text and "video" not in seen.tags


def test_a_film_that_is_gone_is_said(tmp_path):
    seen = written({"suite": "table", "films": [FILM | {"file": "films/a.mp4"}]}, tmp_path)
    assert "a.mp4 cannot be read" in seen.text


def test_without_a_folder_a_failure_is_words_alone():
    body = walk_pictures.film_body([FILM | {"failures": 1, "file": "films/a.mp4"}], None)
    assert "the only failure" in body and "video" not in body
