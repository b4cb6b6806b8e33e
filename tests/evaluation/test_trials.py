"""Trials with known answers: walkers that fall, that are carried, that stand, that blow up."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_world import assert_equal, one
from tiny_policy import SMALL

from cref_jax import config
from cref_jax.config import Config
from cref_jax.env.state import Ending
from cref_jax.evaluation import crossing, protocol, tables, trials
from cref_jax.evaluation.trials import ENDINGS, TrialTrace
from cref_jax.physics.simulation import Physics
from cref_jax.training import rollout

C = config.override(
    Config(),
    {
        "terrain": {"lane_length": 5.0, "lane_width": 1.0},
        "episode": {"bank_size": 4},
        "network": {"variant": "blind"},
    },
)
PERIOD = C.physics.control_period
HIGH = 3.0  # m, above every lane


@pytest.fixture(scope="module")
def physics():
    return Physics(C.robot, C.physics, "mujoco", threads=2)


@pytest.fixture(scope="module")
def world(physics):
    return crossing.crossing_world(C, physics, "flat", 0.0)


def held(env, body, x, z):
    """Return the body upright and still at x, z."""
    qpos = body.qpos.at[:, 0].set(x).at[:, 1].set(0.0).at[:, 2].set(z)
    qpos = qpos.at[:, 3:7].set(jnp.array([1.0, 0.0, 0.0, 0.0]))
    return body._replace(qpos=qpos, qvel=jnp.zeros_like(body.qvel))


def along(env, body):
    return held(env, body, body.qpos[:, 0] + env.command[:, 0] * PERIOD, HIGH)


def still(env, body):
    return held(env, body, env.start[:, 0], HIGH)


def lying(env, body):
    qpos = body.qpos.at[:, 3:7].set(jnp.array([0.5, 0.5, 0.5, 0.5])).at[:, 2].set(HIGH)
    return body._replace(qpos=qpos)


def bursting(env, body):
    beyond = held(env, body, env.start[:, 0] + 3.5, HIGH)
    return beyond._replace(qvel=jnp.full_like(body.qvel, jnp.inf))


def step(which, world, robots):
    """Move the robots' bases, then step them with no action."""
    env = robots.env
    body = jax.lax.switch(which, (along, still, lying, bursting), env, env.body)
    moved = robots.replace(env=env.replace(body=body))
    return rollout.env_step(world, moved, robots.memory, jnp.zeros_like(env.action))


# which of them it is, is a number: so they share one compiled program
carried, stands, falls, blows_up = (
    jax.tree_util.Partial(step, jnp.int32(which)) for which in range(4)
)


def asked(count):
    return trials.TrialSpecs(np.arange(count), *crossing.crossing_lanes(count))


def run(world, walker, count=4, block=3, seed=0):
    return trials.run(world, walker, asked(count), seed, block)


def test_who_is_carried_along_the_lane_always_succeeds(world):
    found = run(world, carried)
    assert found.succeeded.all() and sum(found.failures().values()) == 0
    # from 0.5 to 1 m, to the finish at 4 m
    assert np.all(found.seconds > 3.0 / found.speed - 0.1)
    assert np.all(found.seconds < 3.5 / found.speed + 0.1)
    assert np.all((found.speed >= 0.4) & (found.speed <= 0.8))


def test_who_always_falls_never_succeeds(world):
    found = run(world, falls)
    assert found.failures()["tilted"] == 4
    np.testing.assert_allclose(found.seconds, PERIOD)


def test_who_stands_still_fails_for_lack_of_progress(world):
    found = run(world, stands)
    assert found.failures()["stalled"] == 4
    np.testing.assert_allclose(found.seconds, 10.0 + PERIOD)


def test_who_blows_up_beyond_the_finish_has_failed(world):
    assert run(world, blows_up).failures()["unstable"] == 4


def test_who_looks_is_shown_the_walk_of_each_trial_to_its_end(world):
    walks = {}
    found = trials.run(world, carried, asked(4), 0, 3, look=lambda k, walk: walks.update({k: walk}))
    assert sorted(walks) == [0, 1, 2, 3]
    for k, walk in walks.items():
        assert len(walk.qpos) == len(walk.airborne) == round(found.seconds[k] / PERIOD)
        assert walk.ending == "finished"
        assert walk.airborne[5:].all()  # they are carried high above the lane
        # each step moves the base by the commanded speed
        np.testing.assert_allclose(np.diff(walk.qpos[:, 0]), found.speed[k] * PERIOD, atol=2e-3)


def test_a_trial_does_not_depend_on_how_many_there_are(world):
    few, many = (run(world, carried, count) for count in (2, 8))
    for a, b in zip(few, many, strict=True):
        np.testing.assert_array_equal(a, b[:2])
    assert len(set(many.speed.tolist())) == 8  # each has its own command
    assert not np.array_equal(few.speed, run(world, carried, 2, seed=1).speed)
    # two devices of three slots: the last two begin where others have come to their ends
    last = trials.TrialSpecs(*(x[6:] for x in asked(8)[:3]))
    for a, b in zip(trials.run(world, carried, last, 0, 3), many, strict=True):
        np.testing.assert_array_equal(a, b[6:])


def test_where_one_has_come_to_its_end_the_next_begins():
    slots = trials._Slots(np.arange(8), 3)
    # the numbers 0, 3, 6 have slot 0 of a block, 1, 4, 7 slot 1, and 2, 5 slot 2
    assert slots.blocks == jax.device_count() == 2
    assert slots.fill().tolist() == [0, 1, 2, 3, 4, 5]
    assert slots.trial.tolist() == [0, 1, 2, 3, 4, 5]
    slots.start(np.arange(6), np.full(6, 0.5, np.float32))
    assert slots.fill().size == 0
    seen = trace(trials.CHUNK, robots=6, finished=20)
    flags = seen.ending.finished & (np.arange(6) == 4)
    qpos = np.tile(np.arange(6, dtype=np.float32)[:, None], (trials.CHUNK, 1, 7))
    poses = trials.Poses(qpos, qpos[..., :2] > 3.5)
    over = slots.update((seen._replace(ending=seen.ending._replace(finished=flags)), poses), C)
    ((outcome, walk),) = over.values()
    assert list(over) == [4] and outcome.seconds == pytest.approx(21 * PERIOD)
    np.testing.assert_array_equal(walk.qpos, np.full((21, 7), 4.0))  # its own slot, to its end
    assert walk.airborne.shape == (21, 2) and walk.airborne.all() and walk.ending == "finished"
    assert slots.fill().tolist() == [4] and slots.trial.tolist() == [0, 1, 2, 3, 7, 5]


def test_rows_share_the_slots_evenly():
    # three rows of two trials: the numbers 0, 1 are the places 0, 1, 2 and 3, 4, 5 of the rows
    few = trials._deal_slots(np.tile(np.arange(2), 3), 4)
    assert few.reshape(3, 2).tolist() == [[0, 3], [1, 0], [2, 1]]
    many = trials._deal_slots(np.tile(np.arange(10), 12), 100).reshape(12, 10)
    assert np.bincount(many.ravel(), minlength=100).tolist() == 20 * [2] + 80 * [1]
    # more trials per row move none of them
    more = trials._deal_slots(np.tile(np.arange(25), 12), 100).reshape(12, 25)
    np.testing.assert_array_equal(more[:, :10], many)


def test_a_trial_begins_when_frames_come_as_at_first():
    # 20 Hz at 50 Hz: the frames' pattern comes round every 5 steps
    c = config.override(C, {"network": {"variant": "full"}})
    assert [trials._is_camera_in_phase(c, k) for k in (0, 3, 5, 48, trials.CHUNK)] == [
        True, False, True, False, True,
    ]  # fmt: skip
    assert trials._is_camera_in_phase(C, 3), "a blind policy has no frames"


def test_a_robot_begins_among_others_that_go_on(physics):
    c = dataclasses.replace(C, network=SMALL)
    world = crossing.crossing_world(c, physics, "flat", 0.0)
    old, new = (
        trials.start_robots(world, seed, np.arange(2), *crossing.crossing_lanes(2))
        for seed in (0, 1)
    )
    old = old.replace(feed=old.feed.replace(clock=jnp.int32(50), fresh=jnp.array(True)))
    memory = jax.tree.map(jnp.ones_like, old.memory)
    old = old.replace(memory=memory, begins=jnp.zeros(2, bool))
    found = trials._replace_robots(old, new, np.array([False, True]), c)
    for k, whence in ((0, old), (1, new)):
        for name in ("env", "observation", "begins"):
            assert_equal(one(getattr(found, name), k), one(getattr(whence, name), k))
        assert_equal(one(found.memory.carry, k), one(whence.memory.carry, k))
        of = lambda robots, k=k: jax.tree.map(lambda x: x[:, k], robots.memory.features)
        assert_equal(of(found), of(whence))
        assert_equal(found.feed.frame[k], whence.feed.frame[k])
    assert int(found.feed.clock) == 50 and bool(found.feed.fresh), "the cameras go on"


def test_the_ends_are_told_as_they_come(world):
    told = []
    trials.run(world, carried, asked(5), 0, 3, told.append)
    assert sum(told) == 5 and max(told) < 5


def trace(steps, robots=1, progress=0.01, **flags):
    """Return robots that come `progress` m a step, with flags of Ending raised at a step."""
    raised = np.zeros((steps, robots), bool)
    ending = Ending(
        *(
            np.arange(steps)[:, None] == flags[name] if name in flags else raised
            for name in Ending._fields
        )
    )
    way = progress * np.arange(1, steps + 1)[:, None] * np.ones(robots)
    aside = 0.001 * np.arange(steps)[:, None] * np.ones(robots)
    return TrialTrace(
        ending, way.astype(np.float32), np.full((steps, robots), 0.5, np.float32), aside
    )


@pytest.mark.parametrize(
    ("flags", "progress", "ending", "seconds"),
    [
        ({"finished": 99}, 0.01, "finished", 2.0),
        ({"finished": 99, "timeout": 99}, 0.01, "finished", 2.0),
        ({"finished": 99, "hit": 99}, 0.01, "hit", 2.0),  # falls over the line
        ({"finished": 99, "hit": 100}, 0.01, "finished", 2.0),  # what comes later is another's
        ({"finished": 99, "unstable": 50}, 0.01, "unstable", 1.02),
        ({"tilted": 49, "low": 49}, 0.01, "tilted", 1.0),
        ({"timeout": 599}, 0.01, "late", 12.0),
        ({"finished": 599}, 0.0, "stalled", 10.02),  # it stood for 10 s first
        ({"tilted": 500}, 0.0, "tilted", 10.02),  # it fell in that step
        ({}, 0.01, "late", 12.0),
    ],
)
def test_what_comes_first_decides(flags, progress, ending, seconds):
    found = trials.classify(trace(600, progress=progress, **flags), np.array([0.5]), PERIOD)
    assert ENDINGS[found.ending[0]] == ending
    assert found.seconds[0] == pytest.approx(seconds)
    assert found.forward[0] == pytest.approx(0.5)
    # 1 mm aside a step, and it begins in the middle; the last step's y is that before it
    assert found.drift[0] == found.aside[0] == pytest.approx(0.001 * (seconds / PERIOD - 1))


def test_stairs_are_tried_up_and_down_and_every_lane_in_turn(physics):
    kinds = ("ascent", "descent", "gap", "platform")
    up_down = tables.cell_lanes(("stairs", "hard"), 20, kinds)
    np.testing.assert_array_equal(up_down.kind, [0, 1] * 10)
    variants = len(protocol.LANE_SEEDS)
    assert variants == 5
    np.testing.assert_array_equal(up_down.level[:12] - 10, [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 0, 0])
    gap = tables.cell_lanes(("gap", "easy"), 6, kinds)
    np.testing.assert_array_equal(gap.kind, 2)
    np.testing.assert_array_equal(gap.level, [0, 1, 2, 3, 4, 0])


def test_the_worlds_lanes_have_the_sizes_of_the_cells(physics):
    world = tables.cell_world(C, physics)
    kinds = world.lanes.kinds
    for cell, kind in {("stairs", "medium"): "descent", ("platform", "ood"): "platform"}.items():
        on = tables.cell_lanes(cell, 10, kinds)
        sizes = world.lanes.sizes[on.level, kinds.index(kind)]
        np.testing.assert_array_equal(sizes, tables.cell_sizes()[cell[0]][cell[1]])
    assert all(
        world.lanes.is_profile
    )  # so that kinds may share a block: see camera_feed.render_frames


def made(successes, count, speed=0.45, cause="low"):
    ending = np.full(count, ENDINGS.index(cause))
    ending[:successes] = 0
    one = np.ones(count, np.float32)
    return trials.Trials(np.full(count, speed, np.float32), ending, one, one, 0.1 * one, 0.3 * one)


def outcomes(successes, count, **how):
    """Return the same outcome in every cell; the second half of stairs goes down."""
    down = np.arange(count) >= count // 2
    return {
        cell: tables.CellOutcomes(made(successes, count, **how), down & (cell[0] == "stairs"))
        for cell in dict.fromkeys(
            (kind, level) for kind in tables.LANES for level in ("easy", "medium", "hard", "ood")
        )
    }


def test_a_row_counts_failures_by_way_cause_and_speed():
    row = tables.cell_rows([outcomes(7, 10, speed=0.65, cause="hit")])[0]
    assert (row["kind"], row["level"], row["size_m"]) == ("stairs", "easy", 0.10)
    assert (row["trials"], row["successes"], row["rate"]) == (10, 7, 0.7)
    assert (row["up_failures"], row["down_failures"]) == (0, 3)
    assert row["failures"] == {name: 3 * (name == "hit") for name in trials.FAILURES}
    assert [(bin["trials"], bin["successes"]) for bin in row["by_speed"]] == [
        (0, 0), (0, 0), (10, 7), (0, 0),
    ]  # fmt: skip
    assert row["sideways"] == pytest.approx({"drift_m": 0.1, "largest_m": 0.3, "worst_m": 0.3})
    assert row["paper"]["rate"] == 0.9985 and row["paper"]["significant"]
    assert row["paper"]["difference"] == pytest.approx(0.7 - 0.9985)


def test_several_policies_are_pooled_with_their_spread():
    rows = tables.cell_rows([outcomes(10, 10), outcomes(4, 10), outcomes(7, 10)])
    row = rows[-1]
    assert (row["trials"], row["successes"]) == (30, 21)
    assert row["by_policy"] == [1.0, 0.4, 0.7] and row["spread"] == pytest.approx(0.3)
    assert row["up_failures"] is None
    whole = tables.overall(rows)
    assert [whole[key] for key in ("rate", "trained", "ood")] == pytest.approx([0.7, 0.7, 0.7])
    assert whole["paper"] == pytest.approx(0.904583, abs=1e-5)
    assert whole["paper_trained"] == pytest.approx(0.981111, abs=1e-5)


def test_the_width_of_the_interval_is_said():
    # Wilson at 50 of 100: 0.4038 to 0.5962
    assert "+-9.6 at 50 %" in tables.interval_note(100)


def test_training_settings_do_not_change_the_compiled_program():
    a = config.override(C, {"run": {"seed": 3}, "ppo": {"epochs": 1}, "terrain": {"name": "gap"}})
    assert protocol.trial_config(a) == protocol.trial_config(C)
    assert dataclasses.replace(protocol.trial_config(a)).episode.length == 40.0
