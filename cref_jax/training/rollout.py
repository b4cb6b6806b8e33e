"""T steps of E robots under a policy: the one place where the environment meets the learner.

Training and evaluation share it. The robots' axis is E, and every record is [T, E, ...]. All
cameras run on one clock: a clock of its own for each robot would render every image at 50 Hz.
"""

from typing import NamedTuple, no_type_check

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Bool, Float, Float16, Int, Key, PRNGKeyArray

from cref_jax import config, depth, network, ppo
from cref_jax.env import environment, resets
from cref_jax.env.environment import Outcome
from cref_jax.env.observations import Observation
from cref_jax.env.state import Ending, EnvState, even_spread
from cref_jax.env.world import World
from cref_jax.ppo import auxiliary
from cref_jax.training import camera_feed
from cref_jax.training.camera_feed import CameraFeed


class Memory(NamedTuple):
    """What the policy holds between two control steps."""

    carry: network.Carry
    features: network.Features | None  # of the frame at hand, [1, E, ...]; None for a blind policy
    twin: "Memory | None" = None  # of the same policy in the mirror, where it is taught symmetry


@no_type_check
@flax.struct.dataclass
class Robots:
    """E robots between two control steps, with what their policy remembers."""

    env: EnvState
    observation: Observation
    memory: Memory
    begins: Bool[Array, " E"]  # the next step is the first of an episode
    feed: CameraFeed | None = None  # None for a blind policy


class Networks(NamedTuple):
    """The modules that are trained."""

    actor: network.Actor
    critic: network.Critic
    mirror: ppo.Mirror | None = None  # the symmetry that the actor is taught, if any

    @property
    def functions(self) -> ppo.Networks:
        """The same as functions of their parameters."""
        return ppo.Networks(self.actor.apply, self.critic.apply, self.mirror)


class _Step(NamedTuple):
    """What a horizon is made of, one control step of it."""

    observation: Observation  # that the action was taken on
    begins: Bool[Array, " E"]
    action: Float[Array, "E J"]
    mean: Float[Array, "E J"]
    log_std: Float[Array, "E J"]
    outcome: Outcome
    held: Int[Array, ""]  # the frame at hand, in the album
    seen: Bool[Array, " E"] | None  # None for a blind policy


class Trace(NamedTuple):
    """What happened at each step, apart from what the update needs."""

    reward: Float[Array, "T E"]
    ending: Ending
    measures: environment.Measures


def partition(axis: str, variant: config.Variant, has_twin: bool = False) -> Robots:
    """Return which axis of each array is that of the robots, named `axis`; clocks have none."""
    sees, robots = variant != "blind", P(axis)
    memory = Memory(robots, P(None, axis) if sees else None)
    return Robots(
        env=robots,
        observation=robots,
        memory=memory._replace(twin=memory if has_twin else None),
        begins=robots,
        feed=CameraFeed(frame=robots, seen=robots, fresh=P(), clock=P()) if sees else None,
    )


def networks(c: config.Network, num_actions: int) -> Networks:
    """Return the actor and the critic."""
    return Networks(network.Actor(c, num_actions), network.Critic(c))


def initial_params(
    c: config.Config, num_actions: int, robots: Robots, key: PRNGKeyArray
) -> ppo.Params:
    """Return fresh parameters for observations of the robots' shapes."""
    key_actor, key_critic = jax.random.split(key)
    one = lambda x: x[None, :1]
    seen, begins = robots.observation, one(robots.begins)
    carry, nets = network.initial_carry(c.network, 1), networks(c.network, num_actions)
    sight = robots.feed and network.Sight(
        one(robots.feed.frame), jnp.zeros_like(begins, jnp.int32), begins
    )
    (_, said), actor = nets.actor.init_with_output(
        key_actor, carry, one(seen.proprioception), begins, sight
    )
    shape = said.feature.shape[-1], c.scan.x[2] * c.scan.y[2]
    return ppo.Params(
        actor=actor,
        critic=nets.critic.init(key_critic, one(seen.privileged)),
        readout=auxiliary.initial_readout(*shape) if c.ppo.readout_weight else None,
    )


def start(world: World, key: PRNGKeyArray, num_envs: int) -> Robots:
    """Put E robots on their lanes: kinds in turn, low levels at random, episodes out of step."""
    c = world.config
    key_level, key_reset, key_see, key_step = jax.random.split(key, 4)
    kinds = jnp.asarray(world.lanes.kind_of(np.arange(num_envs)))
    highest = min(c.curriculum.start_level, world.lanes.levels - 1)
    levels = jax.random.randint(key_level, (num_envs,), 0, highest + 1)
    split = lambda k: jax.random.split(k, num_envs)
    state = jax.vmap(resets.reset, in_axes=(None, 0, 0, 0))(world, split(key_reset), kinds, levels)
    longest = round(c.episode.length / c.physics.control_period)
    state = state.replace(step=jax.random.randint(key_step, (num_envs,), 0, longest))
    return init_robots(world, state, split(key_see))


def init_robots(world: World, state: EnvState, keys: Key[Array, " E"]) -> Robots:
    """Return the robots in these states, with nothing seen or remembered; a key for each."""
    c, num_envs = world.config, state.kind.shape[0]
    seen = jax.vmap(environment.observe, in_axes=(None, 0, 0))(world, state, keys)
    sees = c.network.variant != "blind"
    return Robots(
        env=state,
        observation=seen,
        memory=Memory(
            network.initial_carry(c.network, num_envs),
            network.no_features(c.network, c.camera.shape, num_envs) if sees else None,
        ),
        begins=jnp.ones(num_envs, bool),
        feed=camera_feed.empty_feed(c, num_envs) if sees else None,
    )


def with_randomization(robots: Robots, share: Float[Array, ""]) -> Robots:
    """Return the robots with this share of all that is randomised from the next draw on."""
    spread = even_spread(jnp.broadcast_to(share, robots.begins.shape))
    return robots.replace(env=robots.env.replace(spread=spread))


def with_twins(robots: Robots) -> Robots:
    """Return the robots with an empty memory of the same policy in the mirror."""
    blank = jax.tree.map(jnp.zeros_like, robots.memory)
    return robots.replace(memory=robots.memory._replace(twin=blank))


def policy_step(
    nets: Networks, train: ppo.TrainState, robots: Robots
) -> tuple[Memory, network.Output]:
    """Return the policy's memory after this step and its outputs, [1, E, ...].

    A frame is encoded when it comes, and its features are held until the next one. Where the policy
    is taught symmetry, its twin senses and sees the same in the mirror, and remembers that.
    """
    seen, feed, memory = robots.observation.proprioception, robots.feed, robots.memory
    after, output = _apply_actor(nets, train, robots.begins, seen, feed, memory)
    if nets.mirror is not None and memory.twin is not None:
        reflected = feed and feed.replace(frame=nets.mirror.frames(feed.frame))
        twin, _ = _apply_actor(
            nets, train, robots.begins, nets.mirror.obs(seen), reflected, memory.twin
        )
        after = after._replace(twin=twin)
    return after, output


def _apply_actor(
    nets: Networks,
    train: ppo.TrainState,
    begins: Bool[Array, " E"],
    proprioception: Float[Array, "E O"],
    feed: CameraFeed | None,
    memory: Memory,
) -> tuple[Memory, network.Output]:
    """Do what `act` does for one memory."""
    params, features = train.params.actor, memory.features
    obs = ppo.normalise(train.statistics.obs, proprioception)
    view = None
    if feed is not None:
        encode = lambda: nets.actor.apply(params, feed.frame[None], method="encode")
        features = jax.lax.cond(feed.fresh, encode, lambda: features)
        view = network.View(features, jnp.zeros_like(feed.seen[None], jnp.int32), feed.seen[None])
    carry, output = nets.actor.apply(
        params, memory.carry, obs[None], begins[None], view, method="decide"
    )
    return Memory(carry, features), output


def env_step(
    world: World, robots: Robots, memory: Memory, action: Float[Array, "E J"]
) -> tuple[Robots, Outcome]:
    """Step every robot with its action, and its camera."""
    state, outcome = environment.step_all(world, robots.env, action)
    over = outcome.ending.terminated | outcome.ending.truncated
    feed = robots.feed and camera_feed.update_feed(world, robots.feed, robots.env, over)
    return Robots(state, outcome.observation, memory, begins=over, feed=feed), outcome


def collect(
    world: World, nets: Networks, train: ppo.TrainState, robots: Robots, key: PRNGKeyArray
) -> tuple[Robots, ppo.Rollout, Trace]:
    """Return a horizon of experience, with actions drawn from the policy.

    The features of the frame at hand are those of older parameters, so it is encoded anew; after
    the horizon they are dropped, since they can be had from the frame.
    """
    c = world.config
    first = robots
    if robots.feed is not None:
        robots = robots.replace(feed=robots.feed.replace(fresh=jnp.ones((), bool)))

    def step(watch: _Collection, noise: Float[Array, "E J"]) -> tuple[_Collection, _Step]:
        robots = watch.robots
        memory, policy = policy_step(nets, train, robots)
        mean = policy.mean[0]
        action = mean + jnp.exp(policy.log_std) * noise
        after, outcome = env_step(world, robots, memory, action)
        log_std = jnp.broadcast_to(policy.log_std, mean.shape)
        seen = robots.feed and robots.feed.seen
        done = _Step(
            robots.observation, robots.begins, action, mean, log_std, outcome, watch.held, seen
        )
        return _store_frame(watch.replace(robots=after)), done

    keys = jax.random.split(key, c.ppo.horizon)
    draw = lambda key: jax.random.normal(key, robots.env.action.shape)
    watch, steps = jax.lax.scan(step, _start_buffer(c, robots), jax.vmap(draw)(keys))
    after = watch.robots
    after = after.replace(memory=_clear_features(after.memory))
    rollout = _to_rollout(c, nets, train, first.memory, watch.album, steps)
    outcome = steps.outcome
    return after, rollout, Trace(outcome.reward, outcome.ending, outcome.measures)


def _clear_features(memory: Memory) -> Memory:
    """Return what is remembered, with blank features of the frame at hand."""
    twin = memory.twin and _clear_features(memory.twin)
    return memory._replace(features=jax.tree.map(jnp.zeros_like, memory.features), twin=twin)


@no_type_check
@flax.struct.dataclass
class _Collection:
    """The robots during a horizon, and the frames that have come so far."""

    robots: Robots
    album: Float16[Array, "K E rows columns pixels"] | None
    held: Int[Array, ""]  # where the frame at hand is in the album


def _start_buffer(c: config.Config, robots: Robots) -> _Collection:
    """Return the start of a horizon: the frame at hand is the album's first."""
    album = None
    if robots.feed is not None:
        count = 1 + depth.most_frames(c.ppo.horizon - 1, c.camera, c.physics.control_period)
        album = jnp.zeros((count, *robots.feed.frame.shape), robots.feed.frame.dtype)
        album = album.at[0].set(robots.feed.frame)
    return _Collection(robots, album, jnp.zeros((), jnp.int32))


def _store_frame(watch: _Collection) -> _Collection:
    """Put a frame that has just come into the album; one after the last step is the next's."""
    feed, album = watch.robots.feed, watch.album
    if feed is None or album is None:
        return watch
    held = watch.held + feed.fresh.astype(jnp.int32)
    add = lambda: album.at[held].set(feed.frame, mode="drop")
    return watch.replace(album=jax.lax.cond(feed.fresh, add, lambda: album), held=held)


def _to_rollout(
    c: config.Config,
    nets: Networks,
    train: ppo.TrainState,
    memory: Memory,
    album: Float16[Array, "K E rows columns pixels"] | None,
    steps: _Step,
) -> ppo.Rollout:
    """Return a horizon's steps as the update takes them."""
    value = lambda s: nets.critic.apply(
        train.params.critic, ppo.normalise(train.statistics.critic_obs, s)
    )
    outcome, sight = steps.outcome, None
    if album is not None and steps.seen is not None:
        held = jnp.broadcast_to(steps.held[:, None], steps.seen.shape)
        hold = depth.longest_hold(c.camera, c.physics.control_period)
        sight = network.Sight(album, held, steps.seen, hold)
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
    )
