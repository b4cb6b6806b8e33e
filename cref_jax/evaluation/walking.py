"""Episodes on flat ground, each counted until its robot's first end."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cref_jax import ppo
from cref_jax.config import Config
from cref_jax.env.state import Ending
from cref_jax.env.world import World, make_world
from cref_jax.evaluation import gait_pattern, lateral_drift, protocol, trials
from cref_jax.evaluation.protocol import SECONDS
from cref_jax.physics.simulation import Physics
from cref_jax.training import rollout


class WalkResult(NamedTuple):
    """Outcome of E episodes."""

    episodes: int
    fell: int
    by_cause: dict[str, int]
    speed_error: float  # m/s, |commanded - walked| forward, mean over episodes
    tracking_error: float  # m/s, of the planar velocity at each step
    airborne: tuple[float, float]  # share of time off the ground, left and right foot
    step_seconds: float | None  # mean time between touchdowns of one foot; None without any
    sideways: dict[str, float]  # m, see lateral_drift.summarize
    gait: list[dict[str, Any]]  # of the first episode, see gait_pattern.describe

    def line(self) -> str:
        """Format the outcome as one line."""
        left, right = self.airborne
        return (
            f"{self.episodes - self.fell} of {self.episodes} episodes without a fall, "
            f"speed error {self.speed_error:.3f} m/s, "
            f"feet off the ground {left:.0%} and {right:.0%} of the time, "
            + (f"{self.step_seconds:.2f} s per stride" if self.step_seconds else "no steps")
        )


class _EpisodeStep(NamedTuple):
    """Contributions of one step to an episode's sums."""

    alive: Bool[Array, " E"]
    forward_speed: Float[Array, " E"]
    forward_error: Float[Array, " E"]
    tracking_error: Float[Array, " E"]
    airborne: Bool[Array, "E F"]
    y: Float[Array, " E"]  # m, before the step


def walk(
    c: Config, physics: Physics, train: ppo.TrainState, episodes: int = 100, seed: int = 0
) -> WalkResult:
    """Run the policy's mean action on the flat lane, without noise or pushes."""
    flat = dataclasses.replace(c.terrain, name="flat")
    world = make_world(protocol.evaluation_config(dataclasses.replace(c, terrain=flat)), physics)
    steps = round(SECONDS / c.physics.control_period)
    key = jax.random.key(trials.SEED + seed)
    ending, trace = _run_episodes(world, train, key, episodes, steps)
    return _summarize(jax.tree.map(np.asarray, ending), jax.tree.map(np.asarray, trace), c)


def pool(walks: Sequence[WalkResult]) -> WalkResult:
    """Pool the outcomes of policies, each with as many episodes; the gait is the first one's."""
    total = lambda name: sum(getattr(w, name) for w in walks)
    average = lambda values: float(np.mean(list(values)))
    strides = [w.step_seconds for w in walks if w.step_seconds is not None]
    return WalkResult(
        episodes=total("episodes"),
        fell=total("fell"),
        by_cause={cause: sum(w.by_cause[cause] for w in walks) for cause in walks[0].by_cause},
        speed_error=average(w.speed_error for w in walks),
        tracking_error=average(w.tracking_error for w in walks),
        airborne=(average(w.airborne[0] for w in walks), average(w.airborne[1] for w in walks)),
        step_seconds=average(strides) if strides else None,
        sideways={
            "drift_m": average(w.sideways["drift_m"] for w in walks),
            "largest_m": average(w.sideways["largest_m"] for w in walks),
            "worst_m": max(w.sideways["worst_m"] for w in walks),
        },
        gait=walks[0].gait,
    )


@jax.jit(static_argnames=("episodes", "steps"))
def _run_episodes(
    world: World, train: ppo.TrainState, key: PRNGKeyArray, episodes: int, steps: int
) -> tuple[Ending, _EpisodeStep]:
    """Simulate the episodes; return each robot's first end and its steps [T, E] until then."""
    robots = rollout.start(world, jax.random.split(key, episodes))
    robots = robots.replace(env=robots.env.replace(step=jnp.zeros_like(robots.env.step)))

    def step(
        carry: tuple[rollout.Robots, Bool[Array, " E"]], _: None
    ) -> tuple[tuple[rollout.Robots, Bool[Array, " E"]], tuple[Ending, _EpisodeStep]]:
        before, alive = carry
        robots, _policy, outcome = rollout.step_policy(world, train, before)
        measures, ending = outcome.measures, outcome.ending
        counted = Ending(*(flag & alive for flag in ending))
        record = _EpisodeStep(
            alive=alive,
            forward_speed=measures.forward_speed,
            forward_error=measures.forward_command - measures.forward_speed,
            tracking_error=measures.speed_error,
            airborne=measures.airborne,
            y=before.env.body.qpos[:, 1],
        )
        return (robots, alive & ~ending.terminated & ~ending.truncated), (counted, record)

    first = (robots, jnp.ones(episodes, bool))
    _, (endings, trace) = jax.lax.scan(step, first, None, length=steps)
    return Ending(*(flag.any(axis=0) for flag in endings)), trace


def _count_by_cause(ending: Ending) -> dict[str, int]:
    """Count the falls by cause; several causes at once count as the first."""
    flags = np.stack([getattr(ending, name) for name in trials.FALLS])
    first = np.where(flags.any(axis=0), flags.argmax(axis=0), -1)
    return {name: int((first == k).sum()) for k, name in enumerate(trials.FALLS)}


def _summarize(ending: Ending, trace: _EpisodeStep, c: Config) -> WalkResult:
    first = trace.airborne[trace.alive[:, 0], 0]
    alive, steps = trace.alive, np.maximum(trace.alive.sum(axis=0), 1)
    of_episode = lambda x: np.sum(x * alive, axis=0) / steps
    both = trace.alive[..., None]
    airborne = np.sum(trace.airborne * both, axis=(0, 1)) / np.maximum(alive.sum(), 1)
    touchdowns = (trace.airborne[:-1] & ~trace.airborne[1:] & both[1:]).sum()
    seconds = 2 * alive.sum() * c.physics.control_period  # summed over feet and robots
    return WalkResult(
        episodes=alive.shape[1],
        fell=int(ending.terminated.sum()),
        by_cause=_count_by_cause(ending),
        speed_error=float(np.abs(of_episode(trace.forward_error)).mean()),
        tracking_error=float(of_episode(trace.tracking_error).mean()),
        airborne=(float(airborne[0]), float(airborne[1])),
        step_seconds=float(seconds / touchdowns) if touchdowns else None,
        sideways=lateral_drift.summarize(*lateral_drift.measure(trace.y, alive)),
        gait=[{"lane": "flat", **gait_pattern.describe(first, c.physics.control_period)}],
    )
