"""T steps of E robots under a policy: the one place where environment and learner meet.

Training and evaluation share it. The robots' axis is E, and every record is [T, E, ...]. All
cameras run on one clock: with one clock per robot, every image would be rendered at 50 Hz.
"""

from typing import NamedTuple, no_type_check

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Bool, Float, Float16, Int, Key, PRNGKeyArray, PyTree

from cref_jax import config, depth, network, ppo
from cref_jax.env import environment, resets
from cref_jax.env.environment import Outcome
from cref_jax.env.observations import Observation
from cref_jax.env.state import Ending, EnvState, Spread, even_spread
from cref_jax.env.world import World
from cref_jax.ppo import auxiliary
from cref_jax.training import camera_feed, randomization_ramp
from cref_jax.training.camera_feed import CameraFeed


class Memory(NamedTuple):
    """The policy's memory between two control steps."""

    carry: network.Carry
    features: network.Features | None  # of the current frame, [1, E, ...]; None for a blind policy
    twin: "Memory | None" = None  # of the mirrored policy, if symmetry is taught
    teacher: PyTree = None  # of the policies that this one learns from, if any


@no_type_check
@flax.struct.dataclass
class Robots:
    """E robots between two control steps, with their policy's memory."""

    env: EnvState
    observation: Observation
    memory: Memory
    begins: Bool[Array, " E"]  # the next step is the first of an episode
    feed: CameraFeed | None = None  # None for a blind policy


class Modules(NamedTuple):
    """The trained modules."""

    actor: network.Actor | network.ParkourActor
    critic: network.Critic
    mirror: ppo.Mirror | None = None  # symmetry taught to the actor, if any

    @property
    def functions(self) -> ppo.Networks:
        """The same as functions of their parameters."""
        return ppo.Networks(self.actor.apply, self.critic.apply, self.mirror)


class _Step(NamedTuple):
    """One control step of a horizon."""

    observation: Observation  # before the action
    begins: Bool[Array, " E"]
    action: Float[Array, "E J"]
    mean: Float[Array, "E J"]
    log_std: Float[Array, "E J"]
    outcome: Outcome
    frame_index: Int[Array, ""]  # of the current frame, in `_Collection.frames`
    frame_valid: Bool[Array, " E"] | None  # None for a blind policy


class Keys(NamedTuple):
    """The random numbers of one iteration on one device."""

    robots: Key[Array, " E"]  # the same for a robot on whichever device it is
    update: PRNGKeyArray  # this device's


class Trace(NamedTuple):
    """Per-step results that the update does not need."""

    reward: Float[Array, "T E"]
    ending: Ending
    measures: environment.Measures
    teacher_kl: Float[Array, "T E"] | None = None  # as in ppo.Losses, before the update


def partition(
    axis: str,
    c: config.Network,
    has_twin: bool = False,
    has_teacher: bool = False,
    has_clear: bool = False,
) -> Robots:
    """Return the partition spec of each array over the robots' `axis`; clocks are replicated."""
    robots = P(axis)
    feed = CameraFeed(frame=robots, seen=robots, fresh=P(), clock=P())
    memory = Memory(robots, P(None, axis) if c.sees else None)
    return Robots(
        env=robots,
        observation=robots,
        memory=memory._replace(
            twin=memory if has_twin else None, teacher=robots if has_teacher else None
        ),
        begins=robots,
        feed=feed.replace(clear=robots if has_clear else None) if c.sees else None,
    )


def networks(c: config.Network, num_actions: int) -> Modules:
    """Build the actor and the critic."""
    return Modules(network.build_actor(c, num_actions), network.Critic(c))


def initial_params(
    c: config.Config, num_actions: int, robots: Robots, key: PRNGKeyArray
) -> ppo.Params:
    """Initialise parameters for observations of the robots' shapes."""
    key_actor, key_critic = jax.random.split(key)
    one = lambda x: x[None, :1]
    observation, begins = robots.observation, one(robots.begins)
    carry, nets = network.initial_carry(c.network, 1), networks(c.network, num_actions)
    sight = observation.heights if observation.heights is None else one(observation.heights)
    if robots.feed is not None:
        held = jnp.zeros_like(begins, jnp.int32)
        sight = network.DepthInput(one(robots.feed.frame), held, begins)
    (_, output), actor = nets.actor.init_with_output(
        key_actor, carry, one(observation.proprioception), begins, sight
    )
    shape = output.feature.shape[-1], c.scan.x[2] * c.scan.y[2]
    return ppo.Params(
        actor=actor,
        critic=nets.critic.init(key_critic, one(observation.privileged)),
        readout=auxiliary.initial_readout(*shape) if c.ppo.readout_weight else None,
    )


def start(world: World, keys: Key[Array, " E"]) -> Robots:
    """Place robots on lanes: kinds in turn, random low levels, episodes at random times."""
    c = world.config
    each = jax.vmap(lambda key: jax.random.split(key, 4))(keys)
    draw = lambda of, end: jax.vmap(lambda key: jax.random.randint(key, (), 0, end))(each[:, of])
    kinds = jnp.asarray(world.lanes.kind_of(np.arange(keys.shape[0])))
    levels = draw(0, min(c.curriculum.start_level, world.lanes.levels - 1) + 1)
    spread = _spread_by_robot(
        world, randomization_ramp.initial_ramp(c.randomisation).share, keys.size
    )
    reset = jax.vmap(resets.reset, in_axes=(None, 0, 0, 0, 0))
    state = reset(world, each[:, 1], kinds, levels, spread)
    state = state.replace(step=draw(2, round(c.episode.length / c.physics.control_period)))
    return init_robots(world, state, each[:, 3])


def init_robots(world: World, state: EnvState, keys: Key[Array, " E"]) -> Robots:
    """Wrap environment states as robots with empty memory and cameras; `keys`: one per robot."""
    c, num_envs = world.config, state.kind.shape[0]
    observation = jax.vmap(environment.observe, in_axes=(None, 0, 0))(world, state, keys)
    sees = c.network.sees
    return Robots(
        env=state,
        observation=observation,
        memory=Memory(
            network.initial_carry(c.network, num_envs),
            network.zero_features(c.network, c.camera.shape, num_envs) if sees else None,
        ),
        begins=jnp.ones(num_envs, bool),
        feed=camera_feed.empty_feed(c, num_envs) if sees else None,
    )


def with_randomization(world: World, robots: Robots, share: Float[Array, ""]) -> Robots:
    """Set the share of the randomisation ranges that later draws use."""
    spread = _spread_by_robot(world, share, robots.begins.size)
    return robots.replace(env=robots.env.replace(spread=spread))


def _spread_by_robot(world: World, share: Float[Array, ""], num_envs: int) -> Spread:
    c = world.config.randomisation
    parts = randomization_ramp.deal_parts(c, world.lanes, num_envs)
    spread = even_spread(jnp.where(parts.undisturbed | parts.pushed_alone, 0.0, share))
    return spread._replace(pushes=jnp.where(parts.undisturbed, 0.0, share))


def with_twins(robots: Robots) -> Robots:
    """Add an empty memory of the mirrored policy."""
    blank = jax.tree.map(jnp.zeros_like, robots.memory)
    return robots.replace(memory=robots.memory._replace(twin=blank))


def with_teacher(robots: Robots) -> Robots:
    """Add an empty memory of the teacher, which is like the student's."""
    blank = jax.tree.map(jnp.zeros_like, robots.memory.carry)
    return robots.replace(memory=robots.memory._replace(teacher=blank))


def apply_policy(
    nets: Modules, train: ppo.TrainState, robots: Robots
) -> tuple[Memory, network.Output]:
    """Apply the policy; return its memory after this step and its outputs, [1, E, ...].

    A frame is encoded when it arrives, and its features are held until the next one. If symmetry is
    taught, the mirrored policy gets the mirrored inputs and keeps its own memory.
    """
    observation, feed, memory = robots.observation, robots.feed, robots.memory
    after, output = _apply_actor(nets, train, robots.begins, observation, feed, memory)
    if nets.mirror is not None and memory.twin is not None:
        reflected = feed and feed.replace(frame=nets.mirror.frames(feed.frame))
        seen = observation._replace(proprioception=nets.mirror.obs(observation.proprioception))
        twin, _ = _apply_actor(nets, train, robots.begins, seen, reflected, memory.twin)
        after = after._replace(twin=twin)
    return after, output


def _apply_actor(
    nets: Modules,
    train: ppo.TrainState,
    begins: Bool[Array, " E"],
    observation: Observation,
    feed: CameraFeed | None,
    memory: Memory,
) -> tuple[Memory, network.Output]:
    """Apply the actor with one memory, encoding a frame if it is fresh."""
    params, features = train.params.actor, memory.features
    obs = ppo.normalize(train.statistics.obs, observation.proprioception)
    view = None if observation.heights is None else observation.heights[None]
    if feed is not None:
        encode = lambda: nets.actor.apply(params, feed.frame[None], method="encode")
        features = jax.lax.cond(feed.fresh, encode, lambda: features)
        view = network.EncodedInput(
            features, jnp.zeros_like(feed.seen[None], jnp.int32), feed.seen[None]
        )
    carry, output = nets.actor.apply(
        params, memory.carry, obs[None], begins[None], view, method="decide"
    )
    return Memory(carry, features, teacher=memory.teacher), output


def env_step(
    world: World, robots: Robots, memory: Memory, action: Float[Array, "E J"]
) -> tuple[Robots, Outcome]:
    """Step every robot with its action, and the cameras."""
    state, outcome = environment.step_all(world, robots.env, action)
    over = outcome.ending.terminated | outcome.ending.truncated
    feed = robots.feed and camera_feed.update_feed(world, robots.feed, robots.env, over)
    return Robots(state, outcome.observation, memory, begins=over, feed=feed), outcome


def step_policy(
    world: World, train: ppo.TrainState, robots: Robots
) -> tuple[Robots, network.Output, Outcome]:
    """Step every robot with the policy's mean action, without noise.

    The output, [1, E, ...], belongs to the observation before the step.
    """
    nets = networks(world.config.network, world.physics.robot.num_joints)
    memory, output = apply_policy(nets, train, robots)
    after, outcome = env_step(world, robots, memory, output.mean[0])
    return after, output, outcome


def collect(
    world: World,
    nets: Modules,
    train: ppo.TrainState,
    robots: Robots,
    keys: Key[Array, " E"],
    explores: bool = True,
) -> tuple[Robots, ppo.Rollout, Trace]:
    """Collect a horizon of experience, with actions sampled from the policy, or its means.

    The features of the current frame come from older parameters, so it is encoded anew; after the
    horizon they are cleared, since the frame determines them.
    """
    c = world.config
    first = robots
    if robots.feed is not None:
        robots = robots.replace(feed=robots.feed.replace(fresh=jnp.ones((), bool)))

    def step(collection: _Collection, noise: Float[Array, "E J"]) -> tuple[_Collection, _Step]:
        robots = collection.robots
        memory, policy = apply_policy(nets, train, robots)
        mean = policy.mean[0]
        action = mean + jnp.exp(policy.log_std) * noise if explores else mean
        after, outcome = env_step(world, robots, memory, action)
        log_std = jnp.broadcast_to(policy.log_std, mean.shape)
        frame_valid = robots.feed and robots.feed.seen
        done = _Step(
            robots.observation,
            robots.begins,
            action,
            mean,
            log_std,
            outcome,
            collection.frame_index,
            frame_valid,
        )
        return _store_frame(collection.replace(robots=after)), done

    shape = c.ppo.horizon, robots.env.action.shape[-1]
    noise = jax.vmap(lambda key: jax.random.normal(key, shape), out_axes=1)(keys)
    collection, steps = jax.lax.scan(step, _start_buffer(c, robots), noise)
    after = collection.robots
    after = after.replace(memory=_clear_features(after.memory))
    rollout = _to_rollout(c, nets, train, first.memory, collection, steps)
    outcome = steps.outcome
    return after, rollout, Trace(outcome.reward, outcome.ending, outcome.measures)


def _clear_features(memory: Memory) -> Memory:
    """Zero the features of the current frame in a memory."""
    twin = memory.twin and _clear_features(memory.twin)
    return memory._replace(features=jax.tree.map(jnp.zeros_like, memory.features), twin=twin)


@no_type_check
@flax.struct.dataclass
class _Collection:
    """The robots during a horizon, and the frames so far."""

    robots: Robots
    frames: Float16[Array, "K E rows columns pixels"] | None
    frame_index: Int[Array, ""]  # of the current frame in `frames`
    clear: Float16[Array, "K E rows columns pixels"] | None = None  # as in CameraFeed


def _start_buffer(c: config.Config, robots: Robots) -> _Collection:
    """Start a horizon, with the current frame first in the buffer."""
    frames, clear = None, None
    if robots.feed is not None:
        count = 1 + depth.max_frames(c.ppo.horizon - 1, c.camera, c.physics.control_period)
        buffer = lambda x: jnp.zeros((count, *x.shape), x.dtype).at[0].set(x)
        frames, clear = jax.tree.map(buffer, (robots.feed.frame, robots.feed.clear))
    return _Collection(robots, frames, jnp.zeros((), jnp.int32), clear)


def _store_frame(collection: _Collection) -> _Collection:
    """Store a fresh frame in the buffer; one after the last step belongs to the next horizon."""
    feed = collection.robots.feed
    if feed is None:
        return collection
    index = collection.frame_index + feed.fresh.astype(jnp.int32)
    stored, fresh = (collection.frames, collection.clear), (feed.frame, feed.clear)
    put = lambda old, new: old.at[index].set(new, mode="drop")
    add = lambda: jax.tree.map(put, stored, fresh)
    frames, clear = jax.lax.cond(feed.fresh, add, lambda: stored)
    return collection.replace(frames=frames, frame_index=index, clear=clear)


def _to_rollout(
    c: config.Config,
    nets: Modules,
    train: ppo.TrainState,
    memory: Memory,
    collection: _Collection,
    steps: _Step,
) -> ppo.Rollout:
    """Assemble the rollout that the update takes from a horizon's steps."""
    value = lambda s: nets.critic.apply(
        train.params.critic, ppo.normalize(train.statistics.critic_obs, s)
    )
    outcome, frames = steps.outcome, collection.frames
    sight = guide = steps.observation.heights
    if frames is not None and steps.frame_valid is not None:
        index = jnp.broadcast_to(steps.frame_index[:, None], steps.frame_valid.shape)
        hold = depth.longest_hold(c.camera, c.physics.control_period)
        sight = network.DepthInput(frames, index, steps.frame_valid, hold)
        guide = guide if collection.clear is None else sight.replace(frames=collection.clear)
    return ppo.Rollout(
        obs=steps.observation.proprioception,
        critic_obs=steps.observation.privileged,
        velocity=steps.observation.velocity,
        action=steps.action,
        mean=steps.mean,
        log_std=steps.log_std,
        reward=outcome.reward,
        value=value(steps.observation.privileged),
        next_value=value(outcome.last_privileged),
        terminated=outcome.ending.terminated,
        truncated=outcome.ending.truncated,
        begins=steps.begins,
        valid=~outcome.ending.unstable,
        carry=memory.carry,
        sight=sight,
        twin=memory.twin and memory.twin.carry,
        guide=None if memory.teacher is None else guide,
    )
