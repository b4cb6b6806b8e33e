"""A policy learns from one teacher per kind of lane, and each teacher is asked on its own alone."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_world
import tiny_policy
from tiny_policy import SMALL

from cref_jax import config, ppo
from cref_jax.env import environment
from cref_jax.errors import ConfigError
from cref_jax.policy import sources, warm_start
from cref_jax.training import (
    camera_feed,
    imitation,
    iteration,
    randomization_ramp,
    resumption,
    rollout,
)
from cref_jax.training.checkpoint import Checkpoints
from cref_jax.training.imitation import Teacher

T, E = 4, 16  # two robots on each kind of small_world's turns


def settings(*teachers: str, **ppo_settings: float) -> config.Config:
    changes = {
        "run": {"num_envs": E},
        "ppo": {"horizon": T, "minibatches": 2, "imitation_weight": 1.0, **ppo_settings},
        "distillation": {"teachers": list(teachers)},
    }
    return dataclasses.replace(config.override(small_world.C, changes), network=SMALL)


def of(*teachers: str, **randomisation: float | bool) -> config.Config:
    return config.override(settings(*teachers), {"randomisation": randomisation})


def test_lanes_are_numbered_by_teacher_and_the_rest_is_the_first_ones(world):
    assert world.lanes.kinds[:3] == ("flat", "rough", "slope") and world.lanes.levels == 3
    named = of("slope=b", "flat:2=a", "gap:0-1=b")
    assert imitation.list_teachers(named.distillation) == ["b", "a"]
    disturbed, undisturbed = imitation.number_lanes(named, world.lanes)
    assert np.array_equal(disturbed, undisturbed)
    numbers = disturbed.tolist()
    by_kind = dict(zip(world.lanes.kinds, numbers, strict=True))
    assert by_kind.pop("slope") == [1, 1, 1]
    assert by_kind.pop("gap") == [1, 1, 0]
    assert by_kind.pop("flat") == [0, 0, 2]
    assert all(of_kind == [0, 0, 0] for of_kind in by_kind.values())


def test_robots_with_nothing_randomised_have_a_teacher_of_their_own(world):
    c = of("undisturbed:1-2=a", "slope=b", undisturbed=0.5)
    disturbed, undisturbed = imitation.number_lanes(c, world.lanes)
    slope, flat = (world.lanes.kinds.index(kind) for kind in ("slope", "flat"))
    assert disturbed[slope].tolist() == [2, 2, 2] and disturbed[flat].tolist() == [0, 0, 0]
    assert undisturbed[slope].tolist() == [2, 1, 1] and undisturbed[flat].tolist() == [0, 1, 1]


def test_a_kind_of_undisturbed_lane_goes_before_all_of_them(world):
    c = of("undisturbed=a", "undisturbed/gap:1=b", "slope=c", undisturbed=0.5)
    disturbed, undisturbed = imitation.number_lanes(c, world.lanes)
    gap, slope = (world.lanes.kinds.index(kind) for kind in ("gap", "slope"))
    assert undisturbed[gap].tolist() == [1, 2, 1] and undisturbed[slope].tolist() == [1, 1, 1]
    assert disturbed[gap].tolist() == [0, 0, 0] and disturbed[slope].tolist() == [3, 3, 3]


def test_who_is_pushed_alone_has_both_teachers_and_the_others_have_one(world):
    c = of("undisturbed=a", "slope=b", undisturbed=0.3, pushed_alone=0.3)
    robots = 5 * len(world.lanes.turns)
    parts = randomization_ramp.deal_parts(c.randomisation, world.lanes, robots)
    numbers = imitation.number_robots(c, world.lanes, robots)
    by_lane = imitation.number_lanes(c, world.lanes)
    assert parts.undisturbed.any() and parts.pushed_alone.any()
    for robot in range(robots):
        kind = world.lanes.kind_of(np.array([robot]))[0]
        has = not parts.undisturbed[robot], parts.undisturbed[robot] | parts.pushed_alone[robot]
        for group, asked in enumerate(has):
            expected = by_lane[group, kind].tolist() if asked else [-2, -2, -2]
            assert numbers[group, robot].tolist() == expected


def test_time_since_a_push_worked_by_hand():
    begins = jnp.array([[0, 1], [0, 0], [0, 0], [1, 0]], bool)
    pushed = jnp.array([[1, 0], [0, 1], [0, 0], [0, 0]], bool)
    since, before = imitation._count_since_push(jnp.array([7, 9]), begins, pushed)
    never = imitation._LONG_AGO
    assert before.T.tolist() == [[7, 0, 1, never], [never, never + 1, 0, 1]]
    assert since.tolist() == [never + 1, 2]


def test_a_push_brings_the_other_teacher_for_a_while(taught, collected, monkeypatch):
    (world, state), (nets, seen, trace) = taught, collected
    c = of("undisturbed=other", pushed_alone=1.0)
    monkeypatch.setattr(imitation, "AFTER_PUSH", 2 * c.physics.control_period)
    world = world.replace(config=c)
    seen = seen._replace(begins=jnp.zeros_like(seen.begins))
    pushed = jnp.zeros((T, E), bool).at[0].set(True)
    memory, target, _ = imitation.ask_teachers(
        world,
        nets.actor,
        state.teachers,
        state.robots.memory.teacher,
        seen,
        trace.measures._replace(pushed=pushed),
    )
    said = [
        nets.actor.apply(
            teacher.actor,
            state.robots.memory.carry,
            ppo.normalize(teacher.obs, seen.obs),
            seen.begins,
            seen.sight,
        )
        for teacher in state.teachers
    ]
    for step, number in enumerate((1, 0, 0, 1)):
        np.testing.assert_allclose(target[step], said[number][1].mean[step], atol=1e-5)
    for kept, (carry, _) in zip(memory[:2], said, strict=True):
        np.testing.assert_allclose(kept.gru, carry.gru, atol=1e-5)
    np.testing.assert_array_equal(memory.since_push, np.full(E, T - 1))


def test_teachers_can_sense_the_truth():
    faults = {"enabled": True, "depth_noise": 0.05, "depth_dead": 0.3}
    c = config.override(of(**faults), {"distillation": {"true_senses": True}})
    world = small_world.world().replace(config=c)
    state = jax.jit(iteration.initial_state)(world)
    nets = rollout.networks(SMALL, world.physics.robot.num_joints)
    keys = jax.random.split(jax.random.key(1), E)
    own = Teacher(state.train.params.actor, state.train.statistics.obs)
    collect = jax.jit(lambda r: rollout.collect(world, nets, state.train, r, keys))
    robots, seen, trace = collect(state.robots)
    _, target, _ = imitation.ask_teachers(
        world, nets.actor, (own,), state.robots.memory.teacher, seen, trace.measures
    )
    exact = seen.critic_obs[..., : seen.obs.shape[-1]]
    assert float(jnp.abs(exact - seen.obs).max()) > 0.1  # joint velocities are noisy
    assert float(jnp.abs(seen.guide.frames - seen.sight.frames).max()) > 0.01
    _, said = nets.actor.apply(
        own.actor, seen.carry, ppo.normalize(own.obs, exact), seen.begins, seen.guide
    )
    np.testing.assert_allclose(target, said.mean, atol=1e-5)
    no_faults = world.replace(config=config.override(c, {"randomisation": {"enabled": False}}))
    look = jax.jit(camera_feed.render_frames)
    both = camera_feed._render_all(world, robots.env, environment.depth_images)
    for image, there in zip(both, (world, no_faults), strict=True):
        np.testing.assert_allclose(image, look(there, robots.env), atol=1e-3)  # of 16 bits


def test_true_senses_without_teachers_are_refused():
    c = config.override(settings(imitation_weight=0.0), {"distillation": {"true_senses": True}})
    with pytest.raises(ConfigError, match=r"true-senses: --ppo.imitation-weight must be above 0"):
        warm_start.check_teachers(c, None, resumes=False)


def test_lanes_can_have_no_teacher(taught, collected):
    (world, state), (nets, seen, trace) = taught, collected
    world = world.replace(config=settings("slope=none", "gap=other"))
    assert imitation.list_teachers(world.config.distillation) == ["other"]
    _, target, apart = imitation.ask_teachers(
        world,
        nets.actor,
        state.teachers,
        state.robots.memory.teacher,
        seen,
        trace.measures,
    )
    slopes = world.lanes.kind_of(np.arange(E)) == world.lanes.kinds.index("slope")
    for said in (target[..., 0], apart):
        np.testing.assert_array_equal(jnp.isnan(said), np.broadcast_to(slopes, (T, E)))


@pytest.mark.parametrize(
    ("teachers", "says"),
    [
        (("undisturbed=a",), "'undisturbed' needs --randomisation.undisturbed or"),
        (("undisturbed/gap=a",), "'undisturbed/gap' needs --randomisation.undisturbed or"),
        (("disturbed/gap=a",), "unknown kind of lane 'disturbed/gap'"),
        (("flat",), "'flat' is not KIND=POLICY or KIND:FIRST-LAST=POLICY"),
        (("=a",), "'=a' is not KIND=POLICY"),
        (("flat:=a",), "'flat:=a' is not KIND=POLICY"),
        (("flat:high=a",), "'flat:high=a' is not KIND=POLICY"),
        (("flat=a", "flat=b"), "two for a level of 'flat'; give one"),
        (("flat:0-1=a", "flat:1-2=b"), "two for a level of 'flat'; give one"),
        (("flat:1-3=a",), "'flat:1-3' must be levels that rise, of 0 to 2"),
        (("flat:2-1=a",), "'flat:2-1' must be levels that rise, of 0 to 2"),
        (("stair_up=a",), "unknown kind of lane 'stair_up'; did you mean 'stairs_up'?"),
    ],
)
def test_a_wrong_teacher_is_named(world, teachers, says):
    with pytest.raises(ConfigError, match=says):
        imitation.number_lanes(of(*teachers), world.lanes)


@pytest.fixture(scope="module")
def taught():
    """A world whose slopes have a teacher of their own, and a run's state in it."""
    world = small_world.world().replace(config=settings("slope=other"))
    state = jax.jit(iteration.initial_state)(world)
    first, second = (Teacher(p.train.params.actor, p.train.statistics.obs) for p in policies())
    return world, state.replace(teachers=(first, second))


@pytest.fixture(scope="module")
def collected(taught):
    """The networks of that run, its first rollout and what was measured in it."""
    world, state = taught
    nets = rollout.networks(SMALL, world.physics.robot.num_joints)
    keys = jax.random.split(jax.random.key(1), E)
    collect = jax.jit(lambda robots: rollout.collect(world, nets, state.train, robots, keys))
    _, seen, trace = collect(state.robots)
    return nets, seen, trace


def policies():
    first = tiny_policy.policy("full")
    actor = jax.tree.map(lambda x: 0.8 * x - 0.01, first.train.params.actor)
    train = first.train.replace(params=first.train.params._replace(actor=actor))
    return first, first._replace(train=train)


def test_each_teacher_says_what_it_would_do_on_its_own_lanes_and_remembers(taught):
    world, state = taught
    nets = rollout.networks(SMALL, world.physics.robot.num_joints)
    slopes = world.lanes.kind_of(np.arange(E)) == world.lanes.kinds.index("slope")
    assert slopes.sum() == E // len(world.lanes.turns)
    robots, memory = state.robots, state.robots.memory.teacher
    alone = [memory.disturbed, memory.disturbed]
    collect = jax.jit(lambda robots, keys: rollout.collect(world, nets, state.train, robots, keys))
    ask = jax.jit(lambda *a: imitation.ask_teachers(world, nets.actor, state.teachers, *a))
    for seed in (1, 2):
        robots, seen, trace = collect(robots, jax.random.split(jax.random.key(seed), E))
        memory, target, apart = ask(memory, seen, trace.measures)
        for number, teacher in enumerate(state.teachers):
            obs = ppo.normalize(teacher.obs, seen.obs)
            alone[number], said = nets.actor.apply(
                teacher.actor, alone[number], obs, seen.begins, seen.sight
            )
            own = slopes if number else ~slopes
            np.testing.assert_allclose(target[:, own], said.mean[:, own], atol=1e-5)
            assert np.abs(target[:, ~own] - said.mean[:, ~own]).max() > 0.01
            np.testing.assert_allclose(memory.disturbed.gru[own], alone[number].gru[own], atol=1e-5)
        # sum over joints of (m - m')^2 / (2 s^2)
        shift = (target - seen.mean) * np.exp(-seen.log_std)
        np.testing.assert_allclose(apart, 0.5 * np.square(shift).sum(axis=-1), rtol=1e-4)


@pytest.mark.parametrize("levels", [(0, 1), (1, 0)])
def test_a_new_episode_on_another_level_has_that_levels_teacher(taught, collected, levels):
    (world, state), (nets, seen, trace) = taught, collected
    world = world.replace(config=settings("slope:1=other"))
    seen = seen._replace(begins=seen.begins.at[:].set(False).at[2].set(True))
    level = jnp.repeat(jnp.array(levels), 2)[:, None] * jnp.ones((T, E), int)
    carry = jax.tree.map(lambda x: x + 0.5, state.robots.memory.carry)
    begun = state.robots.memory.teacher._replace(disturbed=carry)
    memory, target, _ = imitation.ask_teachers(
        world, nets.actor, state.teachers, begun, seen, trace.measures._replace(level=level)
    )
    slopes = world.lanes.kind_of(np.arange(E)) == world.lanes.kinds.index("slope")
    for steps, number in zip((slice(0, 2), slice(2, 4)), levels, strict=True):
        teacher = state.teachers[number]
        obs = ppo.normalize(teacher.obs, seen.obs)
        carry, said = nets.actor.apply(teacher.actor, begun.disturbed, obs, seen.begins, seen.sight)
        np.testing.assert_allclose(target[steps, slopes], said.mean[steps, slopes], atol=1e-5)
    np.testing.assert_allclose(memory.disturbed.gru[slopes], carry.gru[slopes], atol=1e-5)


def test_who_learns_from_itself_is_where_it_should_be(taught, collected):
    (world, state), (nets, seen, trace) = taught, collected
    own = Teacher(state.train.params.actor, state.train.statistics.obs)
    *_, apart = imitation.ask_teachers(
        world, nets.actor, (own, own), state.robots.memory.teacher, seen, trace.measures
    )
    assert float(jnp.abs(apart).max()) < 1e-6


def test_an_iteration_brings_the_policy_nearer_and_leaves_the_teachers_alone(taught):
    world, state = taught
    keen = settings("slope=other", imitation_weight=100.0, learning_rate=0.003, target_kl=10.0)
    world = world.replace(config=keen)
    before = jax.tree.map(np.asarray, state.teachers)
    copied = jax.tree.map(lambda x: x.copy() if hasattr(x, "copy") else x, state)
    after, log = iteration.chunk(world, copied, iteration.make_mesh(), 20)
    jax.tree.map(np.testing.assert_array_equal, before, jax.tree.map(np.asarray, after.teachers))
    for kind in ("flat", "slope"):
        apart = log[f"teacher_kl/{kind}"]
        assert float(apart[-1]) < 0.5 * float(apart[0]), kind
    assert float(log["loss/teacher_kl"][-1]) < 0.5 * float(log["loss/teacher_kl"][0])


def test_without_teachers_nothing_is_said_of_them(world):
    c = dataclasses.replace(settings(imitation_weight=0.0), network=SMALL)
    state = jax.eval_shape(iteration.initial_state, world.replace(config=c))
    assert state.teachers == () and state.robots.memory.teacher is None
    _, log = jax.eval_shape(
        lambda w, s: iteration.chunk(w, s, iteration.make_mesh(), 1), world.replace(config=c), state
    )
    assert not [name for name in log if name.startswith("teacher_kl")]


def test_a_resumed_run_has_the_teachers_that_it_had(taught, tmp_path):
    _, state = taught
    few = small_world.world().replace(
        config=config.override(settings("slope=other"), {"run": {"num_envs": 8}})
    )
    with Checkpoints(tmp_path) as steps:
        steps.save(1, state, {"num_envs": E, "shares": 1})
        fresh = jax.jit(iteration.initial_state)(few)
        back = resumption.restore(steps, fresh, {"num_envs": 8, "shares": 1})
    assert back.robots.begins.shape == (8,)
    jax.tree.map(np.testing.assert_array_equal, back.teachers, state.teachers)


def test_the_first_teacher_is_what_the_run_begins_as(taught, monkeypatch):
    world, state = taught
    first, second = policies()
    by_name = {Path("begin"): first, Path("other"): second}
    monkeypatch.setattr(sources, "load", lambda path, _: by_name[path])
    monkeypatch.setattr(warm_start, "has_critic", lambda *_: False)
    learned, teachers = warm_start.start(state, Path("begin"), world)
    for teacher, policy in zip(teachers, (first, second), strict=True):
        small_world.assert_equal(teacher.actor, policy.train.params.actor)
        small_world.assert_equal(teacher.obs, policy.train.statistics.obs)
    small_world.assert_equal(learned.params.actor, first.train.params.actor)
    assert learned.teacher is None


def test_a_teacher_of_another_network_is_refused(monkeypatch):
    c = settings("slope=other")
    wider = dataclasses.replace(c, network=dataclasses.replace(SMALL, gru=9))
    monkeypatch.setattr(sources, "read_config", lambda _: wider)
    monkeypatch.setattr(sources, "check_robot", lambda *_: None)
    with pytest.raises(ConfigError, match=r"teachers other has another network: gru is 9, .* 7"):
        warm_start.check_teachers(c, Path("begin"), resumes=False)
    warm_start.check_teachers(c, None, resumes=True)  # the checkpoint has them


@pytest.mark.parametrize(
    ("weight", "teachers", "variant", "says"),
    [
        (0.0, ("flat=a",), "full", "--ppo.imitation-weight must be above 0"),
        (1.0, (), "full", "say --init POLICY"),
        (1.0, (), "hpl", "must be 0 with --network.variant hpl"),
    ],
)
def test_teachers_without_a_loss_and_a_loss_without_a_teacher_are_refused(
    weight, teachers, variant, says
):
    c = settings(*teachers, imitation_weight=weight)
    c = dataclasses.replace(c, network=network_of(variant))
    with pytest.raises(ConfigError, match=says):
        warm_start.check_teachers(c, None, resumes=False)


def network_of(variant: config.Variant) -> config.Network:
    return dataclasses.replace(SMALL, variant=variant)
