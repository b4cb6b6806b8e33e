"""One iteration of training, and a chunk of iterations as one compiled program.

An iteration is one horizon of experience and one update. Its random numbers depend only on the seed
and the iteration number, so neither the chunk length nor a resumption changes any result.

The robots are sharded over the devices of a mesh. Each device collects experience from its own
robots; gradients are averaged, so all devices hold the same parameters.
"""

import functools
from typing import no_type_check

import flax.struct
import jax
import jax.numpy as jnp
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Float, Int, PyTree

from cref_jax import config, network, ppo
from cref_jax.env.world import World
from cref_jax.ppo import Losses
from cref_jax.training import distillation, imitation, mirror, randomization_ramp, rollout
from cref_jax.training.imitation import Teacher
from cref_jax.training.randomization_ramp import Ramp

Log = dict[str, Float[Array, "*n"]]  # by name, one number per iteration

AXIS = "robots"  # of the mesh


@no_type_check  # vmap and tree.map fill it with batches and with non-arrays
@flax.struct.dataclass
class RunState:
    """The state of a run between iterations."""

    train: ppo.TrainState
    robots: rollout.Robots
    ramp: Ramp
    teachers: tuple[Teacher, ...] = ()


def make_mesh(count: int = 1) -> Mesh:
    """Make a mesh of the first `count` devices."""
    devices = jax.devices()[:count]
    return jax.make_mesh((count,), (AXIS,), axis_types=(AxisType.Auto,), devices=devices)


def initial_state(world: World, mesh: Mesh | None = None) -> RunState:
    """Create the state before the first iteration; without a mesh, for one device."""
    c, mesh = world.config, mesh or make_mesh()
    key_robots, key_params = jax.random.split(jax.random.key(c.run.seed))

    def start(world: World, key: Array) -> rollout.Robots:
        robots = rollout.start(world, _robot_keys(key, c.run.num_envs // mesh.size))
        if c.ppo.imitation_weight:
            robots = imitation.with_teachers(robots, c.distillation)
        elif c.network.variant == "hpl":
            robots = rollout.with_teacher(robots)
        return rollout.with_twins(robots) if c.ppo.mirror_weight else robots

    sharded_start = jax.shard_map(
        start,
        mesh=mesh,
        in_specs=(P(), P()),
        out_specs=partition(world).robots,
        check_vma=False,
    )
    robots = sharded_start(world, key_robots)
    observation = robots.observation
    joints = world.physics.robot.num_joints
    params = rollout.initial_params(c, joints, robots, key_params)
    sizes = observation.proprioception.shape[-1], observation.privileged.shape[-1]
    train = ppo.initial_state(params, *sizes, c.ppo)
    if c.network.variant == "hpl":
        teacher = distillation.initial_teacher(c, joints, robots, key_params)
        train = distillation.with_teacher(train, teacher, c)
    whole = NamedSharding(mesh, P())
    train, ramp = jax.lax.with_sharding_constraint(
        (train, randomization_ramp.initial_ramp(c.randomisation)), (whole, whole)
    )
    return RunState(train, robots, ramp, _untrained_teachers(train, c))


def _untrained_teachers(train: ppo.TrainState, c: config.Config) -> tuple[Teacher, ...]:
    """Make room for the teachers, if the run has any: what they know comes with `--init`."""
    if not c.ppo.imitation_weight:
        return ()
    count = 1 + len(imitation.list_teachers(c.distillation))
    return count * (Teacher(train.params.actor, train.statistics.obs),)


@functools.partial(jax.jit, static_argnames="mesh")
def start_student(world: World, taught: RunState, mesh: Mesh) -> RunState:
    """Begin the second stage of a run where the first has ended.

    The teacher is the averaged one. The robots go on from where they are, with a new camera.
    """
    fresh = initial_state(world, mesh)
    train = distillation.with_teacher(fresh.train, taught.train.average, world.config)
    learned = taught.train.params
    train = train.replace(
        params=train.params._replace(critic=learned.critic, readout=learned.readout),
        statistics=taught.train.statistics,
        iteration=taught.train.iteration,
    )
    robots = fresh.robots.replace(
        env=taught.robots.env,
        observation=taught.robots.observation,
        begins=taught.robots.begins,
        memory=fresh.robots.memory._replace(teacher=taught.robots.memory.carry),
    )
    state = RunState(train, robots, taught.ramp)
    place = lambda spec, part: jax.tree.map(
        lambda x: jax.lax.with_sharding_constraint(x, NamedSharding(mesh, spec)), part
    )
    return jax.tree.map(place, partition(world), state, is_leaf=lambda x: isinstance(x, P))


def state_shapes(world: World, mesh: Mesh) -> RunState:
    """Compute the shapes and shardings of a run's state without allocating it."""

    def with_sharding(spec: P, part: PyTree) -> PyTree:
        place = NamedSharding(mesh, spec)
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place), part)

    state = jax.eval_shape(functools.partial(initial_state, mesh=mesh), world)
    return jax.tree.map(with_sharding, partition(world), state, is_leaf=lambda x: isinstance(x, P))


@functools.partial(jax.jit, static_argnames=("mesh", "iterations"), donate_argnames="state")
def chunk(world: World, state: RunState, mesh: Mesh, iterations: int) -> tuple[RunState, Log]:
    """Run `iterations` iterations; every entry of the log is [iterations]."""
    key = jax.random.fold_in(jax.random.key(world.config.run.seed), 1)

    def iteration(state: RunState, _: None) -> tuple[RunState, Log]:
        return _iteration(world, state, mesh, jax.random.fold_in(key, state.train.iteration))

    return jax.lax.scan(iteration, state, None, length=iterations)


def _iteration(world: World, state: RunState, mesh: Mesh, key: Array) -> tuple[RunState, Log]:
    c = world.config
    nets = rollout.networks(c.network, world.physics.robot.num_joints)
    if c.ppo.mirror_weight:
        nets = nets._replace(mirror=mirror.make_mirror(world.physics.model, c.network))

    def learn(
        world: World, state: RunState, key: Array
    ) -> tuple[RunState, Losses | distillation.Losses, rollout.Trace]:
        robots = rollout.with_randomization(world, state.robots, state.ramp.share)
        teach = functools.partial(_reinforce, teachers=state.teachers)
        teach = distillation.learn if c.network.variant == "hpl" else teach
        key_robots, key_update = jax.random.split(key)
        keys = rollout.Keys(
            robots=_robot_keys(key_robots, robots.begins.size),
            update=jax.random.fold_in(key_update, jax.lax.axis_index(AXIS)),
        )
        train, robots, losses, trace = teach(world, nets, state.train, robots, keys, AXIS)
        train = raise_deviations(train, c.network)
        return state.replace(train=train, robots=robots), losses, trace

    parts = partition(world)
    sharded_learn = jax.shard_map(
        learn,
        mesh=mesh,
        in_specs=(P(), parts, P()),
        out_specs=(parts, P(), P(None, AXIS)),
        check_vma=False,
    )
    std = jnp.exp(state.train.params.actor["params"]["log_std"])
    std = jnp.maximum(std, c.network.min_std)
    state, losses, trace = sharded_learn(world, state, key)
    falls = trace.ending.terminated.mean() * (60.0 / c.physics.control_period)
    state = state.replace(ramp=randomization_ramp.update_ramp(state.ramp, falls, c.randomisation))
    log = {
        **_episode_log(trace, world.lanes.kinds, c.physics.control_period),
        **{f"reward/{name}": term.mean() for name, term in trace.measures.terms.items()},
        **{f"loss/{name}": part.mean() for name, part in losses._asdict().items()},
        "train/learning_rate": jnp.ravel(losses.learning_rate)[-1],
        "train/action_std": std.mean(),
        **({"train/randomisation": state.ramp.share} if c.randomisation.enabled else {}),
        **_stage_samples(c, state.train.iteration),
    }
    return state, jax.lax.with_sharding_constraint(log, NamedSharding(mesh, P()))


def _reinforce(
    world: World,
    nets: rollout.Modules,
    train: ppo.TrainState,
    robots: rollout.Robots,
    keys: rollout.Keys,
    axis: str,
    teachers: tuple[Teacher, ...] = (),
) -> tuple[ppo.TrainState, rollout.Robots, Losses, rollout.Trace]:
    """Collect a horizon of experience and learn from it by PPO, and from teachers if there are."""
    taught = robots.memory.teacher
    robots, experience, trace = rollout.collect(world, nets, train, robots, keys.robots)
    if teachers:
        taught, target, teacher_kl = imitation.ask_teachers(
            world, nets.actor, teachers, taught, experience, trace.measures
        )
        experience = experience._replace(target=target)
        trace = trace._replace(teacher_kl=teacher_kl)
        robots = robots.replace(memory=robots.memory._replace(teacher=taught))
    c = world.config.ppo
    train, losses = ppo.update(train, experience, keys.update, c, nets.functions, axis)
    return train, robots, losses, trace


def raise_deviations(train: ppo.TrainState, c: config.Network) -> ppo.TrainState:
    """Raise the actions' deviations to the least one: below it, they would get no gradient."""
    if c.min_std == 0.0:
        return train
    actor = train.params.actor["params"]
    raised = {"params": {**actor, "log_std": network.floor_log_std(actor["log_std"], c.min_std)}}
    return train.replace(params=train.params._replace(actor=raised))


def _stage_samples(c: config.Config, iteration: Int[Array, ""]) -> Log:
    """Log the samples of teacher and student, in the second stage; int32 holds too few of them."""
    if c.network.variant != "hpl":
        return {}
    each = float(c.run.num_envs * c.ppo.horizon)
    last = distillation.teacher_config(c).run.iterations
    of_student = (iteration - last).astype(jnp.float32) * each
    return {"train/teacher_samples": jnp.float32(last * each), "train/student_samples": of_student}


def partition(world: World) -> RunState:
    """Return the partition specs of a run's state: robots are sharded, the rest is replicated."""
    c = world.config
    has_clear = c.ppo.imitation_weight > 0.0 and c.distillation.true_senses
    robots = rollout.partition(
        AXIS, c.network, c.ppo.mirror_weight > 0.0, _has_teacher(c), has_clear
    )
    return RunState(train=P(), robots=robots, ramp=P(), teachers=P())


def _has_teacher(c: config.Config) -> bool:
    """Return whether a teacher acts beside the policy that is trained."""
    return c.network.variant == "hpl" or c.ppo.imitation_weight > 0.0


def _robot_keys(key: Array, count: int) -> Array:
    """Derive a key for each of this device's robots from its index among those of all devices."""
    index = jax.lax.axis_index(AXIS) * count + jnp.arange(count)
    return jax.vmap(functools.partial(jax.random.fold_in, key))(index)


def _episode_log(trace: rollout.Trace, kinds: tuple[str, ...], period: float) -> Log:
    """Compute the log of the steps and of the episodes that ended, partly by kind of terrain.

    `period` is the length of a control step, s.
    """
    ending, measures = trace.ending, trace.measures
    over = ending.terminated | ending.truncated
    masked_mean = lambda x, which: jnp.where(which, x, 0.0).sum() / jnp.maximum(which.sum(), 1)
    distance = measures.foothold_distance
    placed = measures.touchdown & jnp.isfinite(distance)
    log = {
        "episode/length_s": masked_mean(measures.steps * period, over),
        "episode/ended": over.sum().astype(jnp.float32),
        "episode/fell": ending.terminated.sum().astype(jnp.float32),
        "episode/falls_per_minute": ending.terminated.mean() * (60.0 / period),
        "episode/unstable": ending.unstable.sum().astype(jnp.float32),
        "walk/speed_error": measures.speed_error.mean(),
        "walk/forward_speed": measures.forward_speed.mean(),
        "walk/airborne": measures.airborne.mean(),
        "walk/reward": trace.reward.mean(),
        "foothold/distance": masked_mean(distance, placed),
        "foothold/empty": masked_mean(~jnp.isfinite(distance), measures.touchdown),
    }
    if trace.teacher_kl is not None:
        taught = ~jnp.isnan(trace.teacher_kl)
        log["teacher_kl/mean"] = masked_mean(trace.teacher_kl, taught)
    for number, kind in enumerate(kinds):
        here = measures.kind == number
        log[f"level/{kind}"] = masked_mean(measures.rank, here)
        log[f"fell/{kind}"] = masked_mean(ending.terminated, here & over)
        if trace.teacher_kl is not None:
            log[f"teacher_kl/{kind}"] = masked_mean(trace.teacher_kl, here & taught)
    return log
