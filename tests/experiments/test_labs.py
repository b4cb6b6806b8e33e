"""What the laboratories in experiments/ find, on lanes and images that are known beforehand."""

import csv
import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Bool, Int
from PIL import Image
from tiny_policy import ROBOT, SMALL, policy

from cref_jax import cli, config
from cref_jax.config import Config
from cref_jax.env.world import World, build_world
from cref_jax.errors import ConfigError
from cref_jax.evaluation import attention, recorder, touchdowns
from cref_jax.evaluation.recorder import Moment, StepRecords
from cref_jax.policy import writer
from cref_jax.terrain import atlas, cross_section, lanes
from cref_jax.terrain.cross_section import DOWN, UP

CELL = 0.1  # m


def lab(name: str) -> ModuleType:
    """Return a script of experiments/ as a module."""
    path = Path(__file__).parents[2] / "experiments" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


foothold_lab, gate_lab, attention_lab = map(lab, ("foothold_lab", "gate_lab", "attention_lab"))


def steps_up_and_down() -> cross_section.Profile:
    """Return level ground to 1 m, treads of 0.3 m at 0.2 and 0.4 m, 0.6 m at the top, and down."""
    heights = [(10, 0.0), (3, 0.2), (3, 0.4), (10, 0.6), (3, 0.4), (3, 0.2), (8, 0.0)]
    return cross_section.from_heights(
        np.repeat([z for _, z in heights], [n for n, _ in heights]), CELL
    )


def landed(x, z):
    found = cross_section.place_on_treads(
        steps_up_and_down(), np.array([x]), np.array([z]), 0.1, 0.05
    )
    return float(found.position[0]), int(found.flight[0])


def test_a_tread_lies_between_risers_of_one_direction():
    p = steps_up_and_down()
    assert p.flight.tolist() == [0, UP, UP, 0, DOWN, DOWN, 0]
    np.testing.assert_allclose(p.left, [0.0, 1.0, 1.3, 1.6, 2.6, 2.9, 3.2])
    np.testing.assert_allclose(cross_section.riser_edges(p), [1.0, 1.3, 1.6, 2.6, 2.9, 3.2])


@pytest.mark.parametrize(
    ("x", "z", "position", "flight"),
    [
        (1.12, 0.20, 0.12, UP),  # tread 1.0 to 1.3: the nosing is at 1.0
        (1.35, 0.42, 0.05, UP),  # second tread, from 1.3
        (1.26, 0.40, -0.04, UP),  # the centre hangs 4 cm before the second tread
        (2.70, 0.40, 0.20, DOWN),  # tread 2.6 to 2.9: the nosing is at 2.9
        (3.15, 0.20, 0.05, DOWN),
        (2.95, 0.40, -0.05, DOWN),  # the centre hangs 5 cm over the nosing
    ],
)
def test_position_from_the_nosing_towards_the_riser(x, z, position, flight):
    assert landed(x, z) == (pytest.approx(position), flight)


@pytest.mark.parametrize(("x", "z"), [(0.5, 0.0), (2.0, 0.6), (3.9, 0.0), (1.1, 0.28), (0.85, 0.2)])
def test_landings_risers_and_what_is_out_of_reach_are_no_treads(x, z):
    position, flight = landed(x, z)
    assert flight == 0 and np.isnan(position)


def test_the_flight_under_a_robot():
    x = np.array([[0.5, 1.1, 1.5, 2.0], [2.7, 3.1, 3.5, 99.0]])
    assert cross_section.flight_at(steps_up_and_down(), x).tolist() == [
        [0, UP, UP, 0],
        [DOWN, DOWN, 0, 0],
    ]


def flights(rise: float) -> atlas.Atlas:
    """Return a lane with a flight up beside one with a flight down."""
    return lanes.build_grid(config.Terrain(), {"ascent": (rise,), "descent": (rise,)}, [1])


def test_the_stairs_have_the_tread_that_is_drawn():
    atlas = flights(0.20)
    for kind, way in enumerate((UP, DOWN)):
        p = cross_section.from_lane(atlas.tile(0, kind))
        treads = p.flight != 0
        assert set(p.flight[treads]) == {way}
        np.testing.assert_allclose((p.right - p.left)[treads], foothold_lab.TREAD, atol=1e-9)
        np.testing.assert_allclose(np.diff(p.height), way * 0.20, atol=1e-6)


def test_robots_stand_on_all_lanes_in_turn():
    atlas = lanes.build_grid(config.Terrain(), {"flat": (0.0,), "gap": (0.3,)}, [1, 2])
    kinds, levels = recorder.round_robin_lanes(atlas, 6)
    assert list(zip(kinds, levels, strict=True)) == [
        (0, 0), (1, 0), (0, 1), (1, 1), (0, 0), (1, 0)
    ]  # fmt: skip


def test_medium_lanes_have_the_medium_sizes_of_table_2():
    atlas = recorder.medium_lanes(Config())
    sizes = dict(zip(atlas.kinds, np.asarray(atlas.sizes[0]), strict=True))
    assert (sizes["stairs_up"], sizes["gap"], sizes["platform"]) == (0.15, 0.50, 0.30)
    # Table II has no slope and no rough ground: the middle of 0 to 0.35 and of 0 to 0.06
    assert (sizes["slope"], sizes["rough"]) == (pytest.approx(0.175), pytest.approx(0.03))


def test_what_a_robot_walks_on():
    # flat, and one gap lane whose first trench begins where its heights leave zero
    both = lanes.build_grid(config.Terrain(), {"flat": (0.0,), "gap": (0.5,)}, [1])
    edge = 0.02 * np.argmax(cross_section.middle_heights(both.tile(0, 1)) < 0)
    x = np.array([[1.0, edge - 0.6], [5.0, edge - 0.4], [9.0, edge + 0.2]])
    names = recorder.terrain_under(both, x).tolist()
    assert names == [["flat", ""], ["flat", "gap"], ["flat", "gap"]]


def test_median_absolute_deviation():
    # median 3; deviations 2, 1, 0, 1, 97 have the median 1
    assert touchdowns.median_absolute_deviation(np.array([1.0, 2.0, 3.0, 4.0, 100.0])) == 1.0


def stairs_steps(touchdown, air_time, x, z, riser, distance):
    """Return one robot on each lane with its left foot at (x, z); the right one hangs still."""
    count = len(x)
    both = lambda left, still: np.stack(
        [np.stack([left, np.full(count, still)], axis=-1)] * 2, axis=1
    )
    sole = np.stack([both(x, 0.0), np.zeros((count, 2, 2)), both(z, 0.0)], axis=-1)
    return foothold_lab.Step(
        base_x=np.stack([x, x], axis=1),
        sole=sole,
        touchdown=both(touchdown, False),
        air_time=both(air_time, 0.0),
        distance=both(distance, np.inf),
        foot_riser=both(riser, False),
        shank_riser=both(np.zeros(count, bool), False),
    )


def test_only_touchdowns_before_a_failure_count_and_no_rocking():
    atlas = flights(0.20)
    p = cross_section.from_lane(atlas.tile(0, 0))
    tread = int(np.flatnonzero(p.flight == UP)[0])
    x = np.full(5, p.left[tread] + 0.1)
    seen = stairs_steps(
        touchdown=np.array([True, True, True, False, True]),
        air_time=np.array([0.2, 0.2, 0.02, 0.0, 0.2]),  # the third is a foot that rocks
        x=x,
        z=np.full(5, p.height[tread]),
        riser=np.array([True, True, False, True, True]),  # begins twice while it lives
        distance=np.array([0.3, np.inf, 0.1, 0.1, 0.1]),  # the second has no candidate
    )
    alive = np.array([[True, False]] * 4 + [[False, False]])
    world = SimpleNamespace(lanes=atlas, config=Config())
    ways = foothold_lab.summarize(world, StepRecords(alive, seen))
    up, down = ways[UP], ways[DOWN]
    assert (up.robots, up.reached, up.crossed) == (1, 1, 0)
    np.testing.assert_allclose(up.position, [0.1, 0.1], atol=1e-6)
    assert (up.robot.tolist(), up.foot.tolist()) == ([0, 0], [0, 0])
    assert (up.time.tolist(), up.distance.tolist()) == ([0.02, 0.04], [0.3, np.inf])
    said = "2 touchdowns, median 10.0 cm, MAD 0.0 cm, median d_xz"
    assert up.format_touchdowns().endswith(f"{said} undefined: half had no candidate")
    nearer = up._replace(distance=np.array([0.3, 0.1]))
    assert nearer.format_touchdowns().endswith(f"{said} 20.0 cm")
    assert down.format_touchdowns().endswith("0 touchdowns")
    assert (up.foot_riser, up.shank_riser, up.collided) == (2, 0, 1)
    assert (down.robots, len(down.position), down.collided) == (1, 0, 0)
    table = list(foothold_lab.make_rows({"mine": ways}))
    ten = pytest.approx(10.0, abs=1e-4)
    assert table[0] == ("mine", "ascent", 0, "left", 0.02, ten, pytest.approx(30.0))
    assert table[1:] == [("mine", "ascent", 0, "left", 0.04, ten, "")]


def test_toes_touch_a_riser_once_they_are_at_it(world):
    world = world.replace(lanes=flights(0.20))
    p = cross_section.from_lane(world.lanes.tile(0, 0))
    state = jax.tree.map(lambda a: a[0], recorder.start_robots(world, 0, 1).env)
    links = world.physics.links(state.body)
    balls = ROBOT.spheres
    x = foothold_lab.kinematics.points(links, balls.body, balls.position)[:, 0]
    toe = x[balls.foot >= 0].max()
    feet = jax.jit(lambda s: foothold_lab._feet_and_riser_hits(world, s)[1])
    for away, touches in ((0.05, False), (0.008, True)):  # m; a sole's sphere has 0.01
        moved = p.left[1] - away - float(toe)
        qpos = state.body.qpos.at[jnp.array([0, 2])].add(jnp.array([moved, 0.05]))  # in the air
        hits = feet(state.replace(body=state.body._replace(qpos=qpos)))
        assert bool(hits[balls.foot >= 0].any()) == touches


def test_uniform_attention_is_not_enriched_and_concentrated_attention_is_by_all_over_some():
    tokens = np.zeros((2, 48), bool)
    tokens[:, :6] = True  # n = 6 of N = 48
    share, got = attention.compute_shares(np.full((2, 48), 1 / 48), tokens)
    assert (share, got) == pytest.approx((6 / 48, 6 / 48))
    share, got = attention.compute_shares(tokens / 6.0, tokens)
    assert got / share == pytest.approx(48 / 6)


def test_upsampling_keeps_the_mass_where_it_was():
    weights = np.arange(48.0) / np.arange(48.0).sum()
    image = attention.upsample(weights, (6, 8), (48, 64))
    assert image.shape == (48, 64) and image.sum() == pytest.approx(1.0)
    assert image[8:16, 16:24].sum() == pytest.approx(weights[8 + 2])  # row 1, column 2


def plane(slope: float, offset: float) -> np.ndarray:
    """Return the depth of a plane in an image of 48 x 64: 1 / depth is linear in the row."""
    row = np.arange(48.0)[:, None] + np.zeros((1, 64))
    return (1.0 / (offset + slope * row)).astype(np.float32)


def test_a_plane_has_no_edge_even_where_it_leaves_the_range():
    c = Config().camera
    assert not attention.is_edge(jnp.asarray(plane(0.01, 0.5)), c).any()
    leaves = plane(0.02, 0.1)  # beyond 3 m in the upper rows
    assert leaves.max() > c.d_max
    assert not attention.is_edge(jnp.minimum(leaves, c.d_max), c).any()


@pytest.mark.parametrize(("jump", "edge"), [(0.02, False), (0.10, True), (9.0, True)])
def test_a_jump_of_the_ground_is_an_edge_in_its_two_rows(jump, edge):
    c = Config().camera
    metres = plane(0.01, 0.5)
    metres[:20] += jump  # the upper rows lie further away, or beyond the range
    found = np.asarray(attention.is_edge(jnp.minimum(metres, c.d_max), c))
    rows = np.flatnonzero(found.any(axis=1)).tolist()
    assert set(rows) <= {19, 20} and bool(rows) == edge
    tokens = attention.pool_to_tokens(jnp.asarray(found), (6, 8))
    assert np.flatnonzero(tokens).tolist() == (list(range(16, 24)) if edge else [])


def test_rows_look_further_ahead_the_higher_they_are(world):
    ahead = attention.ground_distances(world)
    assert ahead.shape == (6,) and (np.diff(ahead) < 0).all()
    # the camera is 1.0 to 1.2 m up and looks down by 50 deg -+ 29 deg: the row in the image's upper
    # sixth has 25.2 deg, so 1.0 / tan(25.2 deg) = 2.1 to 2.6 m, and a few cm from pelvis to camera
    assert 2.1 < ahead[0] < 2.8


def test_attention_belongs_to_the_frame_of_the_step_before():
    # robot 0 lives through; robot 1 ends in step 2; a frame is exposed in the steps 0 and 2
    exposed = np.array([[True, True], [False, False], [True, True], [False, False]])
    attention = np.arange(4.0)[:, None, None, None] + np.zeros((4, 2, 1, 48))
    none = np.zeros((4, 2, 48), bool)
    seen = attention_lab.Step(exposed, np.zeros((4, 2)), none, none, None, attention)
    alive = np.array([[True, True], [True, True], [True, False], [True, False]])
    frames = attention_lab.select_frames(StepRecords(alive, seen))
    assert frames.step.tolist() == [0, 0, 2] and frames.robot.tolist() == [0, 1, 0]
    assert frames.attention[:, 0, 0].tolist() == [1.0, 1.0, 3.0]


def test_the_mean_map_is_as_rich_as_attention_that_never_moves():
    rng = np.random.default_rng(0)
    attention = np.broadcast_to(rng.dirichlet(np.ones(48)), (9, 2, 48))
    edge = rng.random((9, 48)) < 0.3
    frames = attention_lab.Frames(np.arange(9), np.zeros(9, int), attention, {"ground edge": edge})
    found = list(attention_lab.make_rows(frames, np.full(9, "gap"), np.arange(6.0), (6, 8)))
    assert [row.where for row in found[:2]] == ["ground edge", "row 0, 0.00 m ahead"]
    assert found[0].enrichment == pytest.approx(found[0].enrichment_of_mean_map)
    assert sum(row.attention_share for row in found[1:]) == pytest.approx(1.0)


def test_onsets():
    flag = np.array([True, True, False, True, False])
    assert recorder.find_onsets(flag).tolist() == [True, False, False, True, False]


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: recorder.default_num_envs(0, 9), "--num-envs must be at least 1"),
        (lambda: recorder.count_steps(0.0, Config()), "--seconds must be above 0, up to 40"),
        (lambda: recorder.count_steps(float("nan"), Config()), "--seconds must be above 0"),
        (lambda: recorder.choose_kind(Config(), "gpa"), "did you mean 'gap'"),
        (lambda: cli.prepare_output(Path("gate.jpg"), ".png"), "--out must end in .png"),
    ],
)
def test_a_mistake_is_one_line(call, said):
    with pytest.raises(ConfigError, match=said):
        call()


def test_labels_must_differ():
    for wrong in (("a=1", "a=2"), ("a",), ("=1",)):
        with pytest.raises(ConfigError, match="different LABEL=PATH"):
            foothold_lab.resolve_labels(foothold_lab.Options(policies=wrong))


@pytest.mark.parametrize("variant", ["blind", "no_cross_attention"])
def test_a_policy_without_attention_is_refused(variant):
    with pytest.raises(ConfigError, match=f"no attention: its variant is '{variant}'"):
        attention_lab.check_variant(policy(variant).config)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """Return an exported policy with random parameters."""
    path = tmp_path_factory.mktemp("labs") / "tiny"
    p = policy("full", SMALL)
    writer.write(p, build_world(p.config, "mujoco"), path)
    return path


def columns_of(path: Path) -> tuple[list[str], list[list[str]]]:
    header, *rows = csv.reader(path.open())
    return header, rows


def is_finite(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return True  # a name


@pytest.mark.slow
@pytest.mark.parametrize("name", ["foothold_lab", "gate_lab", "attention_lab"])
def test_a_laboratory_draws_and_writes(tiny, tmp_path, capsys, name):
    script, out = sys.modules[name], tmp_path / "new" / "lab.png"
    asked = ["--policy", str(tiny), "--num-envs", "8", "--seconds", "4", "--out", str(out)]
    script.main(asked)
    with Image.open(out) as image:
        assert image.size[0] > 500
    header, rows = columns_of(out.with_suffix(".csv"))
    assert header == list(script.COLUMNS)
    assert all(len(row) == len(header) and all(map(is_finite, row)) for row in rows)
    assert rows or name == "foothold_lab"  # a random policy climbs no stairs
    assert f"wrote {out}" in capsys.readouterr().out


class Count(NamedTuple):
    """Of each robot: control steps into its episode, and whether it has just ended."""

    step: Int[Array, " E"]
    over: Bool[Array, " E"]


def counted(world: World, moment: Moment) -> Count:
    ending = moment.outcome.ending
    return Count(moment.after.env.step, ending.terminated | ending.truncated)


@pytest.mark.slow
def test_nothing_counts_from_a_robots_end_on():
    blind = policy("blind")
    world = build_world(blind.config, "mujoco")
    world = recorder.make_trial_world(
        blind.config, world, lanes.build_single(Config().terrain, "flat", 0.0), 0.6
    )
    robots = recorder.start_robots(world, 0, 4)
    watched = recorder.record(world, blind.train, robots, 200, counted)
    alive, seen = watched
    assert alive[0].all() and not alive[-1].any()  # a random policy falls within 4 s
    assert len(alive) % recorder.CHUNK == 0 and len(alive) < 200  # and then it is over
    number = np.arange(1, 1 + len(alive))[:, None] + np.zeros((1, 4), int)
    np.testing.assert_array_equal(seen.step[alive], number[alive])  # the first episode, whole
    first = seen.over.argmax(axis=0)
    np.testing.assert_array_equal(alive.sum(axis=0), first)  # and not the step that ends it
    assert seen.step[first, range(4)].tolist() == [0, 0, 0, 0]
