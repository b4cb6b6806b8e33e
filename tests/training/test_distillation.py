"""A student learns what its teacher does, by looking, and nothing else learns."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_world

from cref_jax import config, network, ppo
from cref_jax.training import distillation, iteration, rollout

E, T, J, OBS = 16, 4, 3, 5
C = config.override(
    config.Config(),
    {
        "run": {"num_envs": E, "iterations": 10},
        "ppo": {"horizon": T, "minibatches": 2, "epochs": 2},
        "distillation": {"teacher_iterations": 4, "learning_rate": 3e-3},
        "network": {
            "variant": "hpl",
            "convolutions": [[4, 3, 2]],
            "compressed": 8,
            "gru": 16,
            "actor": [16],
            "critic": [8],
        },
    },
)
STUDENT = network.build_actor(C.network, J)
TEACHER = network.build_actor(distillation.teacher_config(C).network, J)
NEVER = jnp.zeros((T, E), bool)


def test_the_loss_is_the_sum_over_joints_and_the_mean_over_valid_samples():
    target = jnp.array([[[1.0, -2.0], [0.0, 0.0]], [[0.5, 0.5], [9.0, 9.0]]])
    valid = jnp.array([[True, True], [True, False]])
    lesson = distillation.Lesson(jnp.zeros((2, 2, 1)), ~valid, valid, None, target, ())
    zeros = jnp.zeros((2, 2, 3))

    def actor(params, carry, *_):
        mean = jnp.broadcast_to(params, target.shape)
        return carry, network.Output(mean, params, zeros, zeros, zeros, None)

    # means of 0.5 and 0: |0.5 - 1| + |-2| = 2.5, 0.5, and 0.5 of the valid ones
    error = functools.partial(distillation.loss, lesson=lesson, actor=actor)
    params = jnp.array([0.5, 0.0])
    assert float(error(params)) == pytest.approx((2.5 + 0.5 + 0.5) / 3)
    # d/d first joint: -1, +1, and 0 or +-1 where it is exact; second: +1, 0 or +-1, -1
    grad = jax.grad(error)(params + 0.01)
    np.testing.assert_allclose(grad, [(-1 + 1 + 1) / 3, (1 + 1 - 1) / 3], atol=1e-6)


def test_the_first_stage_has_nine_tenths_of_the_iterations_and_each_its_samples():
    c = config.override(C, {"distillation": {"teacher_iterations": 0}})
    assert distillation.fill_in(c).distillation.teacher_iterations == 9
    first = distillation.teacher_config(C)
    assert (first.network.variant, first.run.iterations) == ("hpl_teacher", 4)
    assert distillation.samples_by_stage(C, 3) == {"teacher": 3 * E * T, "student": 0}
    assert distillation.samples_by_stage(C, 6) == {"teacher": 4 * E * T, "student": 2 * E * T}
    assert distillation.samples_by_stage(first, 3) == {}


def lesson_of(teacher, key, sees: bool) -> distillation.Lesson:
    """Return a lesson on ground as high for each robot as its image is bright."""
    key_obs, key_ground = jax.random.split(key)
    obs = jax.random.normal(key_obs, (T, E, OBS))
    bright = jax.random.uniform(key_ground, (1, E, 1, 1), minval=-0.5, maxval=0.5)
    heights = jnp.broadcast_to(bright[..., 0], (T, E, 6))
    carry = network.initial_carry(C.network, E)
    _, output = TEACHER.apply(teacher, carry, obs, NEVER, heights)
    frames = network.image_to_patches(C.network, jnp.broadcast_to(bright, (1, E, 8, 8)))
    sight = network.DepthInput(frames, jnp.zeros((T, E), jnp.int32), jnp.full((T, E), sees), T)
    return distillation.Lesson(obs, NEVER, ~NEVER, sight, output.mean, carry)


@functools.cache
def untaught() -> ppo.TrainState:
    """Return a student before its first lesson, and a teacher who acts on what it sees."""
    key = jax.random.key(0)
    carry, obs = network.initial_carry(C.network, E), jnp.zeros((T, E, OBS))
    teacher = jax.jit(TEACHER.init)(key, carry, obs, NEVER, jnp.zeros((T, E, 6)))
    # both are near 0 at the start of a training
    for part, layer, times in [("action_head", 1, 100.0), ("height_encoder", 2, 500.0)]:
        last = teacher["params"][part][f"layer_{layer}"]
        last["kernel"] = times * last["kernel"]
    blank = lesson_of(teacher, key, True)
    actor = jax.jit(STUDENT.init)(key, carry, obs, NEVER, blank.sight)
    train = ppo.initial_state(ppo.Params(actor, {}), OBS, 1, C.ppo)
    return distillation.with_teacher(train, teacher, C)


def test_a_student_begins_with_all_of_its_teacher_but_the_sight():
    train = untaught()
    ours, theirs = train.params.actor["params"], train.teacher["params"]
    assert set(ours) ^ set(theirs) == {"depth_encoder", "height_encoder"}
    for part in ("gru", "action_head", "log_std"):
        small_world.assert_equal(ours[part], theirs[part])


def errors(sees: bool) -> np.ndarray:
    """Return the loss of each of 200 iterations."""

    @jax.jit
    def learn(train, key):
        key_lesson, key_update = jax.random.split(key)
        lesson = lesson_of(train.teacher, key_lesson, sees)
        train, losses = distillation.update(train, lesson, key_update, C, STUDENT.apply)
        return train, losses.imitation[0, 0]  # before it has learned from this lesson

    return np.asarray(jax.lax.scan(learn, untaught(), jax.random.split(jax.random.key(1), 200))[1])


@pytest.mark.slow
def test_a_student_that_looks_reaches_its_teacher_and_a_masked_one_does_not():
    seeing, masked = errors(True), errors(False)
    assert seeing[-20:].mean() < 0.2 * seeing[0]
    assert masked[-20:].mean() > 3.0 * seeing[-20:].mean()


@functools.cache
def stages():
    """Return a small world, the end of the first stage, the student's beginning and its lessons."""
    c = config.override(
        small_world.C,
        {
            "run": {"num_envs": 4, "iterations": 3, "chunk": 1},
            "ppo": {"horizon": 6, "minibatches": 2, "epochs": 1},
            "distillation": {"teacher_iterations": 1},
            "network": {
                "variant": "hpl",
                "convolutions": [[4, 5, 4], [4, 3, 2]],
                "gru": 8,
                "actor": [8],
                "critic": [8],
            },
        },
    )
    world, mesh = small_world.world().replace(config=c), iteration.make_mesh()
    first = world.replace(config=distillation.teacher_config(c))
    state = jax.jit(iteration.initial_state, static_argnames="mesh")(first, mesh)
    taught, _ = iteration.chunk(first, state, mesh, 1)
    begun = iteration.start_student(world, taught, mesh)
    kept = jax.tree.map(jnp.copy, begun)  # the program takes its input's memory
    after, log = iteration.chunk(world, begun, mesh, 2)
    return world, taught, kept, after, log


@pytest.mark.slow
def test_the_student_begins_where_its_teacher_ended():
    _, taught, begun, _, _ = stages()
    small_world.assert_equal(begun.train.teacher, taught.train.average)
    small_world.assert_equal(begun.robots.env, taught.robots.env)
    small_world.assert_equal(begun.robots.memory.teacher, taught.robots.memory.carry)
    assert int(begun.train.iteration) == 1 and begun.robots.feed is not None
    assert not np.any(begun.robots.memory.carry.gru)


@pytest.mark.slow
def test_lessons_teach_the_student_alone():
    world, _, begun, after, log = stages()
    before, now = begun.train, after.train
    for name in ("teacher", "statistics"):
        small_world.assert_equal(getattr(before, name), getattr(now, name))
    small_world.assert_equal(before.params.critic, now.params.critic)
    for name, part in now.params.actor["params"].items():
        old = jax.tree.leaves(before.params.actor["params"][name])
        moved = [np.abs(a - b).max() for a, b in zip(old, jax.tree.leaves(part), strict=True)]
        assert (min(moved) > 0.0) == (name != "log_std"), name
    np.testing.assert_allclose(log["train/teacher_samples"], [24, 24])  # of 4 robots in 6 steps
    np.testing.assert_allclose(log["train/student_samples"], [24, 48])
    assert np.all(np.asarray(log["loss/imitation"]) > 0.0)
    assert world.config.distillation.learning_rate == pytest.approx(3e-4)
    np.testing.assert_allclose(log["train/learning_rate"], 3e-4, rtol=1e-6)


@pytest.mark.slow
def test_a_lesson_is_what_the_teacher_would_do_where_the_students_mean_action_leads():
    world, _, begun, _, _ = stages()
    nets = rollout.networks(world.config.network, world.physics.robot.num_joints)
    collect = functools.partial(rollout.collect, explores=False)
    _, seen, _ = jax.jit(collect, static_argnums=1)(
        world, nets, begun.train, begun.robots, jax.random.split(jax.random.key(2), 4)
    )
    np.testing.assert_array_equal(seen.action, seen.mean)
    teacher = rollout.networks(
        distillation.teacher_config(world.config).network, seen.action.shape[-1]
    ).actor
    carry, obs = begun.robots.memory.teacher, ppo.normalize(begun.train.statistics.obs, seen.obs)
    steps = []
    for t in range(len(seen.obs)):  # one by one, as it would act
        now = slice(t, t + 1)
        carry, output = teacher.apply(
            begun.train.teacher, carry, obs[now], seen.begins[now], seen.guide[now]
        )
        steps.append(output.mean[0])
    _, whole = teacher.apply(
        begun.train.teacher, begun.robots.memory.teacher, obs, seen.begins, seen.guide
    )
    np.testing.assert_allclose(whole.mean, np.stack(steps), atol=1e-6)
