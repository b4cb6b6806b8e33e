"""The lanes: what lies in them, in metres, and what is said about a file that cannot be used."""

import dataclasses
import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from cref_jax import config, errors, terrain
from cref_jax.config import folders
from cref_jax.errors import ConfigError
from cref_jax.terrain import heightmap, lanes

CELL = 0.02  # m
TRAIN = {  # m, Table II where it has the kind
    "flat": (0.0, 0.0),
    "rough": (0.0, 0.06),
    "slope": (0.0, 0.35),
    "stairs_up": (0.0, 0.20),
    "stairs_down": (0.0, 0.20),
    "gap": (0.0, 0.75),
    "platform": (0.0, 0.40),
}
ALONE = {"ascent": (0.0, 0.20), "descent": (0.0, 0.20)}


@pytest.fixture(scope="module")
def mixed():
    return lanes.build(config.Terrain(name="mixed"))


def profile(atlas, level=0, kind=0):
    """Return the heights along the middle of a lane, f64[X]."""
    return atlas.tile(level, kind).heights[:, atlas.terrain.size[1] // 2].astype(float)


def runs(heights):
    """Return (height, length) of the level stretches of a profile, m."""
    edges = np.flatnonzero(np.diff(heights)) + 1
    return [(part[0], part.size * CELL) for part in np.split(heights, edges)]


def single(kind, size, **changes):
    return profile(lanes.build_single(config.Terrain(**changes), kind, size))


def test_mixed_holds_every_kind_once(mixed):
    assert mixed.kinds == tuple(TRAIN)
    assert mixed.levels == 10
    assert mixed.terrain.size == mixed.tile(9, 6).heights.shape == (600, 200)
    assert mixed.length == pytest.approx(12.0)


def test_robots_are_put_on_the_kinds_in_turn_as_often_as_their_shares_ask_for(mixed):
    # 7 kinds, 4 of them twice, 2 a third and one a fourth time: 7 + 4 + 2 + 1 turns
    assert mixed.turns == (0, 1, 2, 3, 4, 5, 6, 3, 4, 5, 6, 5, 6, 5)
    names = [mixed.kinds[k] for k in mixed.kind_of(np.arange(7, 17))]
    again = ["stairs_up", "stairs_down", "gap", "platform", "gap", "platform", "gap"]
    assert names == [*again, "flat", "rough", "slope"]
    assert lanes.build(config.Terrain(name="stairs")).turns == (0, 1)


@pytest.mark.parametrize(
    ("shares", "says"),
    [
        ("rough = 2", "shares names 'rough', which is not in mix"),
        ("gap = 0", "the share of 'gap' must be 1, 2, ..., not 0"),
        ("gap = 1.5", "the share of 'gap' must be 1, 2, ..., not 1.5"),
    ],
)
def test_shares_that_mean_nothing_are_refused(shares, says, tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(f'mix = ["flat", "gap"]\n[shares]\n{shares}\n')
    with pytest.raises(errors.ConfigError, match=re.escape(says)):
        lanes.build(config.Terrain(name=str(file)))


def test_sizes_run_evenly_from_the_lowest_to_the_highest_of_training(mixed):
    for k, kind in enumerate(mixed.kinds):
        np.testing.assert_allclose(mixed.sizes[:, k], np.linspace(*TRAIN[kind], 10), atol=1e-12)


def test_every_lane_starts_and_ends_level_at_zero(mixed):
    for level, kind in itertools.product(range(10), range(7)):
        heights = mixed.tile(level, kind).heights
        np.testing.assert_array_equal(heights[:75], 0.0)
        np.testing.assert_array_equal(heights[-50:], 0.0)


def test_a_lane_that_is_level_across_is_stored_as_one_column(mixed):
    # 60 of 70 lanes: 600 columns and their blocks of 4, 16 and 64, and the bottoms of the last
    profile_lane, rough = 600 + 150 + 38 + 10 + 10, mixed.is_profile.index(False)
    blocks = [-(-600 // side) * -(-200 // side) for side in terrain.BLOCKS]
    assert mixed.is_profile.count(False) == 1 and mixed.kinds[rough] == "rough"
    assert mixed.terrain.tops.size == 60 * profile_lane + 10 * (sum(blocks) + blocks[-1])


def test_a_tile_has_its_start_at_x_zero_and_its_middle_at_y_zero(mixed):
    ends = jnp.array([[0.01, 0.0], [11.99, -1.99], [-3.0, 1.99], [15.0, 9.0]])
    for kind in range(7):
        np.testing.assert_array_equal(terrain.height_at(mixed.tile(9, kind), ends), 0.0)
    x = (np.arange(600) + 0.5) * CELL
    line = jnp.asarray(np.stack([x, np.full(600, 0.01)], -1), jnp.float32)
    np.testing.assert_array_equal(
        terrain.height_at(mixed.tile(4, 3), line), profile(mixed, 4, 3).astype(np.float32)
    )


def test_a_level_and_a_kind_may_be_traced(mixed):
    look = lambda atlas, level, kind, xy: terrain.height_at(atlas.tile(level, kind), xy)
    levels, kinds, xy = jnp.arange(3), jnp.arange(3) + 3, jnp.full((3, 2), 4.0)
    found = jax.jit(jax.vmap(look, (None, 0, 0, 0)))(mixed, levels, kinds, xy)
    expected = [terrain.height_at(mixed.tile(n, n + 3), xy[n]) for n in range(3)]
    np.testing.assert_array_equal(found, expected)


def test_a_lane_depends_on_its_seed_kind_and_size_only(mixed):
    alone = lanes.build(config.Terrain(name="gap"))
    column = mixed.kinds.index("gap")
    np.testing.assert_array_equal(profile(alone, 5, 0), profile(mixed, 5, column))
    assert (single("gap", 0.5, seed=1) != single("gap", 0.5, seed=2)).any()


@pytest.mark.parametrize("width", [0.10, 0.30, 0.50, 0.75, 0.80])
def test_a_gap_lane_has_three_trenches_a_metre_deep_and_no_narrower_than_asked(width):
    stretches = runs(single("gap", width))
    trenches = [length for height, length in stretches if height == -1.0]
    landings = [length for height, length in stretches if height == 0.0]
    assert len(trenches) == 3 and len(landings) == 4
    assert all(width - 1e-9 <= length < width + CELL for length in trenches)
    assert all(1.5 <= length <= 2.5 + CELL for length in landings[:-1])


@pytest.mark.parametrize(("kind", "size"), [("gap", 0.0), ("gap", 0.75), ("platform", 0.40)])
def test_obstacles_stand_closer_on_the_lanes_of_training(kind, size):
    c = config.Terrain(name=kind)
    atlas = lanes.build(c)
    level = int(np.flatnonzero(np.isclose(atlas.sizes[:, 0], size))[0])
    between = lambda heights: [length for height, length in runs(heights)[1:-1] if height == 0.0]
    ahead, apart = profile(atlas, level), single(kind, size, seed=c.seed)
    if size == 0.0:
        assert not ahead.any()
    else:
        assert len(between(ahead)) > len(between(apart))
        assert all(0.7 <= length <= 1.5 + CELL for length in between(ahead))
    assert runs(ahead)[0][1] >= 1.5 and runs(ahead)[-1][1] >= 1.0


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("rise", [0.05, 0.23])
def test_stairs_rise_evenly_to_a_landing_and_fall_again(rise, seed):
    heights = single("stairs_up", rise, seed=seed)
    changes = np.diff(heights)[np.diff(heights) != 0.0]
    steps = changes.size // 2
    assert 8 <= steps <= 14
    np.testing.assert_allclose(changes, np.repeat([rise, -rise], steps), atol=1e-6)
    stretches = runs(heights)
    np.testing.assert_allclose(stretches[steps], [rise * steps, 2.0], atol=1e-6)
    treads = [length for _, length in stretches[1:steps] + stretches[steps + 1 : -1]]
    np.testing.assert_allclose(treads, treads[0])
    assert round(treads[0], 6) in (0.28, 0.30, 0.32)


def test_stairs_down_go_below_the_start_first():
    changes = np.diff(single("stairs_down", 0.15))
    changes = changes[changes != 0.0]
    steps = changes.size // 2
    np.testing.assert_allclose(changes, np.repeat([-0.15, 0.15], steps), atol=1e-6)


@pytest.mark.parametrize("seed", range(12))
def test_a_flight_rises_evenly_and_stays_above(seed):
    stretches = runs(single("ascent", 0.23, seed=seed))
    heights, lengths = np.array(stretches).T
    steps = len(stretches) - 1
    assert 8 <= steps <= 14
    np.testing.assert_allclose(heights, 0.23 * np.arange(steps + 1), atol=1e-6)
    np.testing.assert_allclose(lengths[1:-1], 0.30)
    assert 1.5 <= lengths[0] <= 2.0 + CELL and lengths[-1] >= 1.0
    np.testing.assert_array_equal(single("descent", 0.23, seed=seed).max(), 0.0)


def test_each_level_has_as_many_variants_as_are_asked_for():
    c = config.Terrain(name="gap", variants=3, seed=5)
    atlas = lanes.build(c)
    assert (atlas.levels, atlas.variants, atlas.sizes.shape) == (10, 3, (10, 1))
    x = jnp.stack([(jnp.arange(600) + 0.5) * CELL, jnp.zeros(600)], axis=1)
    for level, variant in ((0, 2), (4, 0), (9, 1)):
        alone = lanes.build(config.Terrain(name="gap", seed=5 + variant))
        found = terrain.height_at(atlas.tile(level, 0, variant), x)
        np.testing.assert_array_equal(found, terrain.height_at(alone.tile(level, 0), x))
    of_one_level = [terrain.height_at(atlas.tile(9, 0, k), x) for k in range(3)]
    assert (of_one_level[0] != of_one_level[1]).any() and (of_one_level[1] != of_one_level[2]).any()


def test_a_grid_has_each_size_with_each_seed():
    c = config.Terrain()
    atlas = lanes.build_grid(c, {"gap": (0.3, 0.5), "platform": (0.2, 0.4)}, [7, 8, 9])
    assert atlas.levels == 6 and atlas.kinds == ("gap", "platform")
    np.testing.assert_array_equal(atlas.sizes[:, 1], [0.2, 0.2, 0.2, 0.4, 0.4, 0.4])
    for level, (size, seed) in {1: (0.3, 8), 3: (0.5, 7), 5: (0.5, 9)}.items():
        np.testing.assert_array_equal(profile(atlas, level), single("gap", size, seed=seed))


@pytest.mark.parametrize("seed", range(12))
def test_platforms_are_two_or_three_boxes_of_the_height_asked_for(seed):
    stretches = runs(single("platform", 0.43, seed=seed))
    boxes = [(height, length) for height, length in stretches if height > 0.0]
    assert len(boxes) in (2, 3)
    assert all(height == pytest.approx(0.43) for height, _ in boxes)
    assert all(1.2 <= length <= 2.0 + CELL for _, length in boxes)
    assert all(length >= 1.5 for height, length in stretches[:-1] if height == 0.0)


def test_a_slope_has_the_gradient_asked_for_up_and_down():
    gradient = np.diff(single("slope", 0.35)) / CELL
    assert gradient.max() == pytest.approx(0.35, abs=1e-4)
    assert gradient.min() == pytest.approx(-0.35, abs=1e-4)
    np.testing.assert_allclose(gradient.sum(), 0.0, atol=1e-4)


def test_rough_ground_spans_the_height_asked_for_in_gentle_steps():
    atlas = lanes.build_single(config.Terrain(), "rough", 0.06)
    heights = atlas.tile(0, 0).heights
    assert np.ptp(heights) == pytest.approx(0.06, abs=1e-6)
    assert abs(np.diff(heights, axis=0)).max() < 0.01


def test_a_single_lane_has_exactly_the_size_asked_for():
    atlas = lanes.build_single(config.Terrain(name="gap"), "stairs_up", 0.23)
    assert atlas.kinds == ("stairs_up",) and atlas.levels == 1
    assert atlas.sizes[0, 0] == 0.23


def test_a_size_below_zero_is_refused():
    refused("must not be below zero", lanes.build_single, config.Terrain(), "gap", -0.1)


def test_evaluation_sizes_are_those_of_table_2():
    c = config.Terrain()
    sizes = lambda *metres: dict(zip(("easy", "medium", "hard", "ood"), metres, strict=True))
    assert lanes.named_sizes(c, "stairs_up") == sizes(0.10, 0.15, 0.20, 0.23)
    assert lanes.named_sizes(c, "stairs_down") == sizes(0.10, 0.15, 0.20, 0.23)
    assert lanes.named_sizes(c, "gap") == sizes(0.30, 0.50, 0.75, 0.80)
    assert lanes.named_sizes(c, "platform") == sizes(0.20, 0.30, 0.40, 0.43)
    assert lanes.named_sizes(c, "rough") == {}


@pytest.mark.parametrize(
    "path", sorted(folders.data_folder("terrains").glob("*.toml")), ids=lambda p: p.stem
)
def test_every_terrain_file_builds(path):
    small = config.Terrain(name=path.stem, lane_width=1.0, levels=1)
    assert lanes.build(small).sizes[0, 0] == (TRAIN | ALONE)[lanes.build(small).kinds[0]][0]


# A user's own ground


def write_map(folder, heights, settings="cell = 0.1\nstart = [0.55, 0.25]\n"):
    path = folder / "hill.npy"
    np.save(path, heights)
    if settings is not None:
        (folder / "hill.toml").write_text(settings)
    return config.Terrain(name=str(path))


def test_a_height_map_becomes_one_lane_that_starts_at_z_zero(tmp_path):
    heights = 500.0 + np.arange(60.0).reshape(10, 6) / 100.0
    atlas = lanes.build(write_map(tmp_path, heights))
    assert (atlas.kinds, atlas.levels, atlas.terrain.size) == (("custom",), 1, (10, 6))
    # the start lies in column (5, 2); one metre of heights a row of 6 columns apart is 6 cm
    start = jnp.array([heightmap.MAP_START, 0.0])
    found = terrain.height_at(atlas.tile(0, 0), start + jnp.array([[0.0, 0.0], [0.1, 0.0]]))
    np.testing.assert_allclose(found, [0.0, 0.06], atol=1e-6)


@pytest.mark.parametrize("bits", [np.uint8, np.uint16])
def test_a_picture_is_seen_from_above(tmp_path, bits):
    # three columns to the right, two rows; the lower row is y = 0, its left end the start
    Image.fromarray(np.array([[40, 50, 60], [10, 20, 30]], bits)).save(tmp_path / "hill.png")
    (tmp_path / "hill.toml").write_text("cell = 0.1\nscale = 0.01\nstart = [0.05, 0.05]\n")
    atlas = lanes.build(config.Terrain(name=str(tmp_path / "hill.png")))
    expected = [[0.0, 0.3], [0.1, 0.4], [0.2, 0.5]]
    np.testing.assert_allclose(atlas.tile(0, 0).heights, expected, atol=1e-6)
    here = terrain.height_at(atlas.tile(0, 0), jnp.array([heightmap.MAP_START, 0.1]))
    np.testing.assert_allclose(here, 0.3, atol=1e-6)


def test_a_users_own_terrain_file_is_read(tmp_path):
    path = tmp_path / "ditch.toml"
    path.write_text(
        'kinds = ["gap"]\ntrain = [0.2, 0.4]\n'
        "[shape]\ncount = 1\ndepth = 0.3\nlanding = [2.0, 2.0]\n"
    )
    c = config.Terrain(name=str(path), levels=3)
    atlas = lanes.build(c)
    np.testing.assert_allclose(atlas.sizes[:, 0], [0.2, 0.3, 0.4])
    np.testing.assert_allclose(runs(profile(atlas, 2)), [(0, 2), (-0.3, 0.4), (0, 9.6)], atol=1e-6)
    single = lanes.build_single(c, "gap", 0.4)
    assert profile(single).min() == pytest.approx(-0.3)  # its own numbers


# What is said about what cannot be used


def refused(message, call, *args):
    with pytest.raises(ConfigError) as error:
        call(*args)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_an_unknown_terrain_is_met_with_the_nearest_name():
    known = ", ".join(sorted(p.stem for p in folders.data_folder("terrains").glob("*.toml")))
    near = "unknown terrain 'gpa'; did you mean 'gap'?"
    refused(near, lanes.build, config.Terrain(name="gpa"))
    refused(f"unknown terrain 'moon'; known: {known}", lanes.build, config.Terrain(name="moon"))


def test_an_unknown_kind_is_met_with_the_nearest_name():
    refused("did you mean 'stairs_up'?", lanes.build_single, config.Terrain(), "stairs_upp", 0.1)


GAP = 'kinds = ["gap"]\ntrain = [0.1, 0.2]\n[shape]\ncount = 1\ndepth = 1.0\nlanding = [2.0, 2.0]\n'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("depth", "dept", "unknown setting 'mine.toml: shape: dept'; did you mean 'depth'?"),
        ("depth = 1.0\n", "", "mine.toml: shape: 'depth' is missing"),
        ("train", "trian", "did you mean 'train'?"),
        ("train = [0.1, 0.2]\n", "", "mine.toml: 'train' is missing"),
        ("0.1, 0.2", "0.2, 0.1", "train must be [lowest, highest], not [0.2, 0.1]"),
        ("0.1, 0.2", "0.2", "takes 2 values, not 1"),
        ('"gap"', '"gapp"', "unknown kind 'gapp'; did you mean 'gap'?"),
        ('["gap"]', "[]", "mine.toml: kinds must name at least one"),
        ("count = 1", 'count = "1"', "must be int, not '1'"),
        ("depth = 1.0", "depth = 0.0", "shape: depth must be above zero and rising, not 0.0"),
        ("depth = 1.0", "depth = nan", "mine.toml: every number must be finite, not nan"),
        ("0.1, 0.2", "0.0, inf", "mine.toml: every number must be finite, not inf"),
        ("[2.0, 2.0]", "[2.5, 1.5]", "landing must be above zero and rising, not [2.5, 1.5]"),
        ("[shape]", "[practice]\nlanding = [2.0, 1.0]\n[shape]", "practice: landing must be above"),
        ("[shape]", "[practice]\nland = 1\n[shape]", "practice: land'; did you mean 'landing'?"),
        ("[2.0, 2.0]", "[20.0, 20.0]", "lane_length is 12 m, but 21.10 m are needed"),
        ("[shape]", "[levels]\neasy = 0.3\n[shape]", "mine.toml: levels: 'hard' is missing"),
        ("[shape]", "[[shape", "mine.toml"),
    ],
)
def test_a_terrain_file_that_cannot_be_used_is_refused_in_one_line(tmp_path, old, new, message):
    path = tmp_path / "mine.toml"
    path.write_text(GAP.replace(old, new))
    refused(message, lanes.build, config.Terrain(name=str(path)))


def test_a_missing_terrain_file_is_named(tmp_path):
    refused("no file", lanes.build, config.Terrain(name=str(tmp_path / "none.toml")))


def test_a_mix_names_terrains_that_define_kinds(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('mix = ["gap", "mixed"]')
    refused("mixed.toml is a mix itself", lanes.build, config.Terrain(name=str(path)))
    (tmp_path / "wide.toml").write_text(GAP)
    path.write_text(f'mix = ["gap", "{tmp_path}/wide.toml"]')
    said = f"mine.toml: mix: 'gap' and '{tmp_path}/wide.toml' both define the kind 'gap'"
    refused(said, lanes.build, config.Terrain(name=str(path)))
    path.write_text("mix = []")
    refused("mix must name at least one", lanes.build, config.Terrain(name=str(path)))


@pytest.mark.parametrize("kind", [k for k in TRAIN if k != "flat"])
def test_a_lane_too_short_for_its_obstacles_is_refused(kind):
    c = config.Terrain(lane_length=3.4)
    refused("lane_length is 3.4 m, but", lanes.build_single, c, kind, 0.2)


def test_lanes_without_length_are_refused():
    for change in ({"cell": 0.0}, {"lane_length": 0.0}, {"lane_width": -1.0}, {"levels": -1}):
        c = dataclasses.replace(config.Terrain(), **change)
        refused("must be above zero", lanes.build, c)


def test_a_grid_too_large_for_memory_is_refused(tmp_path):
    refused("more than 2e+08", lanes.build, config.Terrain(name="mixed", lane_length=9e3))
    wide = np.broadcast_to(np.float32(0.0), (20_000, 10_001))
    header = np.lib.format.open_memmap(tmp_path / "hill.npy", "w+", np.float32, wide.shape)
    del header
    refused(
        "columns, more than 2e+08", lanes.build, config.Terrain(name=str(tmp_path / "hill.npy"))
    )


@pytest.mark.parametrize(
    ("heights", "message"),
    [
        (np.zeros(5), "must hold numbers [X, Y], not float64(5,)"),
        (np.zeros((0, 4)), "must hold numbers [X, Y]"),
        (np.zeros((4, 4), complex), "must hold numbers [X, Y]"),
        (np.array([[0.0, np.nan], [np.inf, 0.0]]), "has 2 heights that are not finite"),
        (np.zeros((4, 4)), "start [0.55, 0.25] is not on the map, 0.4 x 0.4 m"),
    ],
)
def test_a_height_map_that_cannot_be_used_is_refused(tmp_path, heights, message):
    refused(message, lanes.build, write_map(tmp_path, heights))


def test_a_height_map_needs_its_settings_beside_it(tmp_path):
    refused("hill.toml", lanes.build, write_map(tmp_path, np.zeros((9, 9)), settings=None))
    refused(
        "hill.toml: 'start' is missing",
        lanes.build,
        write_map(tmp_path, np.zeros((9, 9)), "cell = 1"),
    )
    refused(
        "cell must be at least 0.01 m, not 0.0: contact looks three cells far",
        lanes.build,
        write_map(tmp_path, np.zeros((9, 9)), "cell = 0\nstart = [0, 0]"),
    )


def test_a_file_that_is_no_map_is_refused(tmp_path):
    for name in ("none.npy", "none.png"):
        refused(
            f"no file {tmp_path / name}", lanes.build, config.Terrain(name=str(tmp_path / name))
        )
    for name in ("text.npy", "text.png"):
        (tmp_path / name).write_text("not a map")
        refused(name, lanes.build, config.Terrain(name=str(tmp_path / name)))


def test_a_picture_in_colour_is_refused(tmp_path):
    Image.new("RGB", (4, 4)).save(tmp_path / "hill.png")
    refused("must be grey", lanes.build, config.Terrain(name=str(tmp_path / "hill.png")))


def test_half_of_the_lanes_of_training_have_slits_where_the_ground_is_level():
    c = config.Terrain(name="stairs", variants=8, slits=0.04)
    plain, cut = (lanes.build(dataclasses.replace(c, slits=s)) for s in (0.0, 0.04))
    with_slits = 0
    for at in itertools.product((0, 4, 9), range(2), range(8)):  # level, kind, variant
        before, after = (np.asarray(a.tile(*at).heights[:, 0]) for a in (plain, cut))
        depth = before - after
        at = np.flatnonzero(depth)
        with_slits += bool(at.size)
        if not at.size:
            continue
        np.testing.assert_allclose(depth[at], 0.3, atol=1e-6)
        # 1.5 m at the start and 1 m at the end stay whole; 2 columns are 4 cm
        assert at[0] >= 75 and at[-1] < 550
        assert {length for z, length in runs(depth) if z > 0.1} <= {CELL, 2 * CELL}
        edges = np.flatnonzero(np.diff(before))
        if edges.size:
            assert np.abs(at[:, None] - edges).min() >= 3
    assert 14 < with_slits < 34  # of 48


def test_kinds_that_may_not_have_slits_have_none():
    c = config.Terrain(name="mixed", variants=4, slits=0.04, slit_kinds=("stairs_up", "flat"))
    plain, cut = (lanes.build(dataclasses.replace(c, slits=s)) for s in (0.0, 0.04))
    changed = {
        kind
        for k, kind in enumerate(cut.kinds)
        for variant in range(4)
        if not np.array_equal(*(a.tile(5, k, variant).heights for a in (plain, cut)))
    }
    assert changed == {"stairs_up", "flat"}


def test_slits_of_an_unknown_kind_are_refused():
    c = config.Terrain(name="mixed", slits=0.04, slit_kinds=("stair_up",))
    refused("did you mean 'stairs_up'", lanes.build, c)


def test_slits_are_of_training_alone():
    a, b = (lanes.build_single(config.Terrain(slits=s), "gap", 0.5) for s in (0.0, 0.04))
    np.testing.assert_array_equal(profile(a), profile(b))
