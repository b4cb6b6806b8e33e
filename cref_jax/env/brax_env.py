"""The environment in brax's shape, so that brax's agents train it.

    mend_brax()
    robots = BraxEnv(config.Config())
    ppo.train(robots, wrap_env_fn=wrap, episode_length=robots.episode_length,
              network_factory=partial(make_ppo_networks, value_obs_key="privileged_state"), ...)

`environment.step` itself puts a robot whose episode is over on a lane again, with new dynamics and
at the level that the curriculum says, and tells a failure from an episode that was cut. brax's own
wrappers would put every robot back into its very first state, and take each end for a failure;
`wrap` replaces them. Under `brax.envs.training.wrap` the environment runs all the same. A policy of
brax's draws actions within -1 and 1, scaled to joints as `config.Robot` says.
"""

import contextlib
import io
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, PRNGKeyArray

from cref_jax import config
from cref_jax.env import environment, resets
from cref_jax.env.observations import Observation
from cref_jax.env.world import make_world
from cref_jax.physics.records import EngineName
from cref_jax.physics.simulation import Physics, resolve_engine

with contextlib.redirect_stdout(io.StringIO()):  # it reports that warp-lang is not installed
    from brax.envs.base import Env, State, Wrapper


class BraxEnv(Env):
    """One robot as a brax environment; its lanes become a part of the compiled program."""

    def __init__(self, c: config.Config, engine: EngineName = "auto", threads: int = 0) -> None:
        """Build the robot and its lanes; `threads` is for MuJoCo C, 0 means all cores.

        Raises:
            ConfigError: the terrain is unknown or its numbers cannot be used.
        """
        self._backend = resolve_engine(engine)
        self.world = make_world(c, Physics(c.robot, c.physics, self._backend, threads))

    @property
    def episode_length(self) -> int:
        """The longest episode, control steps."""
        c = self.world.config
        return round(c.episode.length / c.physics.control_period)

    @property
    def observation_size(self) -> dict[str, tuple[int, ...]]:
        """The shape of each observation: o^p_t of Eq. 2 and s_t of Eq. 3."""
        return jax.tree.map(lambda x: x.shape, jax.eval_shape(self.reset, jax.random.key(0)).obs)

    @property
    def action_size(self) -> int:
        """The number of joints that the policy drives."""
        return self.world.physics.robot.num_joints

    @property
    def backend(self) -> str:
        """The engine."""
        return self._backend

    def reset(self, rng: PRNGKeyArray) -> State:
        """Reset to a lane of a random kind at one of the start levels."""
        c, lanes = self.world.config, self.world.lanes
        key_kind, key_level, key_reset, key_see = jax.random.split(rng, 4)
        kind = jax.random.randint(key_kind, (), 0, len(lanes.kinds))
        highest = min(c.curriculum.start_level, lanes.levels - 1)
        level = jax.random.randint(key_level, (), 0, highest + 1)
        state = resets.reset(self.world, key_reset, kind, level)
        zero = jnp.zeros(())
        return State(
            pipeline_state=state,
            obs=_obs(environment.observe(self.world, state, key_see)),
            reward=zero,
            done=zero,
            metrics=dict.fromkeys(self._metric_names(), zero),
            info={"cut": zero},
        )

    def step(self, state: State, action: Float[Array, " J"]) -> State:
        """Advance 20 ms; after an end the returned robot and observation are fresh ones.

        `done` says that the episode is over, `info["cut"]` that it was no failure.
        """
        robot, outcome = environment.step(self.world, state.pipeline_state, action)
        cut = outcome.ending.truncated.astype(jnp.float32)
        measures = outcome.measures
        period = self.world.config.physics.control_period
        metrics = {f"reward/{name}": period * value for name, value in measures.terms.items()}
        return state.replace(
            pipeline_state=robot,
            obs=_obs(outcome.observation),
            reward=outcome.reward,
            done=outcome.ending.terminated.astype(jnp.float32) + cut,
            metrics={**state.metrics, **metrics, "speed_error_per_step": measures.speed_error},
            info={**state.info, "cut": cut},
        )

    def _metric_names(self) -> list[str]:
        weights = config.RewardWeights.__dataclass_fields__
        return [*(f"reward/{name}" for name in weights), "speed_error_per_step"]


class SelfResetting(Wrapper):
    """Environments that reset themselves, with the episode records that brax's agents keep."""

    def reset(self, rng: Array) -> State:
        """Reset one environment per key."""
        state = jax.vmap(self.env.reset)(rng)
        zero = jnp.zeros_like(state.reward)
        sums = dict.fromkeys(("sum_reward", "length", *state.metrics), zero)
        flags = dict.fromkeys(("steps", "truncation", "episode_done"), zero)
        return state.replace(info={**state.info, **flags, "episode_metrics": sums})

    def step(self, state: State, action: Float[Array, "E J"]) -> State:
        """Step every environment; the sums are of the episode that the step belongs to."""
        after = jax.vmap(self.env.step)(state, action)
        goes_on = 1.0 - state.info["episode_done"]
        one = jnp.ones_like(after.reward)
        new = {"sum_reward": after.reward, "length": one, **after.metrics}
        old = state.info["episode_metrics"]
        sums = {name: goes_on * old[name] + value for name, value in new.items() if name in old}
        kept = {
            "steps": sums["length"],
            "truncation": after.info["cut"],
            "episode_done": after.done,
            "episode_metrics": sums,
        }
        return after.replace(info={**after.info, **kept})


def wrap(
    env: BraxEnv,
    episode_length: int,
    action_repeat: int = 1,
    randomization_fn: Callable[..., Any] | None = None,
) -> SelfResetting:
    """Wrap the environment for `brax.training`, as its `wrap_env_fn`.

    Raises:
        ValueError: a setting that only the configuration of the environment can change.
    """
    if episode_length != env.episode_length:
        raise ValueError(f"episode_length must be {env.episode_length}, as the configuration says")
    if action_repeat != 1 or randomization_fn is not None:
        raise ValueError("set physics.substeps and randomisation in the configuration instead")
    return SelfResetting(env)


def mend_brax() -> None:
    """Restore the function that brax 0.14.2 calls and jax 0.10 dropped.

    google/brax#671; where it is there, nothing happens.
    """
    if not hasattr(jax, "device_put_replicated"):
        jax.device_put_replicated = _device_put_replicated  # type: ignore[attr-defined]


def _device_put_replicated(tree: Any, devices: list[Any]) -> Any:
    """Copy a tree to each device, along a new first axis."""
    one_each = NamedSharding(Mesh(devices, ("devices",)), PartitionSpec("devices"))
    return jax.tree.map(lambda x: jax.device_put(jnp.stack([x] * len(devices)), one_each), tree)


def _obs(seen: Observation) -> dict[str, Array]:
    """Name the observation's parts as brax's networks expect."""
    return {"state": seen.proprioception, "privileged_state": seen.privileged}
