"""How well a policy walks: deterministic episodes, counted until each robot's first end."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cref_jax import ppo, sideways, trials
from cref_jax.config import Config
from cref_jax.env.state import Ending
from cref_jax.env.world import World, make_world
from cref_jax.physics.simulation import Physics
from cref_jax.terrain import generators, lanes
from cref_jax.training import rollout

COMMANDS = (0.4, 0.8)  # m/s forward, Sec. III-A
SECONDS = 20.0  # of an episode on flat ground; assumed
TRIAL_SECONDS = 40.0  # at most, of a trial on a lane, Sec. III-A
LANE_SEEDS = tuple(range(1001, 1006))  # of the lanes of trials: others than those of training


class Walk(NamedTuple):
    """The outcome of E episodes."""

    episodes: int
    fell: int
    by_cause: dict[str, int]
    speed_error: float  # m/s, |commanded - walked| forward, mean over episodes
    tracking_error: float  # m/s, of the planar velocity at each step
    airborne: tuple[float, float]  # share of time that the left and the right foot are off ground
    step_seconds: float  # mean time between two touchdowns of one foot
    sideways: dict[str, float]  # m, see sideways.summed

    def line(self) -> str:
        """Return the outcome in one line for people."""
        left, right = self.airborne
        return (
            f"{self.episodes - self.fell} of {self.episodes} episodes without a fall, "
            f"speed error {self.speed_error:.3f} m/s, "
            f"feet off the ground {left:.0%} and {right:.0%} of the time, "
            f"{self.step_seconds:.2f} s a stride"
        )


class Crossing(NamedTuple):
    """The outcome of trials on lanes of one kind with obstacles of one size."""

    kind: str
    size_m: float  # of a slope its gradient
    trials: int
    successes: int  # came to the lane's end in time
    by_cause: dict[str, int]  # of the failures
    seconds: float  # mean time of a success
    speed: float  # m/s forward, mean over the trials
    sideways: dict[str, float] | None = (
        None  # m, see sideways.summed; None for a robot in another simulation
    )

    def line(self) -> str:
        """Return the outcome in one line for people."""
        causes = ", ".join(f"{n} {cause}" for cause, n in self.by_cause.items() if n)
        return (
            f"{self.kind} {generators.extent(self.kind, self.size_m)}: {self.successes} of "
            f"{self.trials} trials crossed, {self.seconds:.1f} s each, {self.speed:.2f} m/s"
            + (f"; failures: {causes}" if causes else "")
        )


class _Step(NamedTuple):
    """What one step of an episode adds to its sums."""

    alive: Bool[Array, " E"]
    forward_speed: Float[Array, " E"]
    forward_error: Float[Array, " E"]
    tracking_error: Float[Array, " E"]
    airborne: Bool[Array, "E F"]
    y: Float[Array, " E"]  # m, before the step


def evaluation_config(c: Config, seconds: float = SECONDS) -> Config:
    """Return the configuration to judge in: nothing randomised, forward commands, heading held."""
    return dataclasses.replace(
        c,
        randomisation=dataclasses.replace(c.randomisation, enabled=False),
        curriculum=dataclasses.replace(c.curriculum, enabled=False),
        command=dataclasses.replace(
            c.command,
            lane_vx=COMMANDS,
            lane_free=0.0,
            open_kinds=(),
            period=(2 * seconds, 2 * seconds),
        ),
        episode=dataclasses.replace(c.episode, length=seconds, stall_time=0.0, start_anywhere=0.0),
    )


def walk(
    c: Config, physics: Physics, train: ppo.TrainState, episodes: int = 100, seed: int = 0
) -> Walk:
    """Return how the policy's mean action does on the flat lane, without noise or pushes."""
    flat = dataclasses.replace(c.terrain, name="flat")
    world = make_world(evaluation_config(dataclasses.replace(c, terrain=flat)), physics)
    steps = round(SECONDS / c.physics.control_period)
    key = jax.random.key(trials.SEED + seed)
    ending, trace = _episodes(world, train, key, episodes, steps)
    return _judged(jax.tree.map(np.asarray, ending), jax.tree.map(np.asarray, trace), c)


def cross(
    c: Config,
    physics: Physics,
    train: ppo.TrainState,
    kind: str,
    size: float,
    count: int = 200,
    seed: int = 0,
    ended: Callable[[int], None] = lambda count: None,
) -> Crossing:
    """Return how often the policy's mean action comes to the end of lanes with such obstacles."""
    world = crossing_world(c, physics, kind, size)
    asked = trials.Asked(np.arange(count), *crossing_lanes(count))
    made = trials.run(world, trials.follow(train), asked, seed, block(), ended)
    done = made.succeeded
    return Crossing(
        kind=kind,
        size_m=size,
        trials=count,
        successes=int(done.sum()),
        by_cause=made.failures(),
        seconds=float(made.seconds[done].mean()) if done.any() else float("nan"),
        speed=float(made.forward.mean()),
        sideways=sideways.summed(made.drift, made.aside),
    )


def crossing_world(c: Config, physics: Physics, kind: str, size: float) -> World:
    """Return the world of trials on lanes of one kind with obstacles of one size, m."""
    atlas = lanes.grid(c.terrain, {kind: (size,)}, LANE_SEEDS)
    return make_world(trial_config(c), physics).replace(lanes=atlas)


def crossing_lanes(count: int) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Return kind and level of the lanes of so many trials in `crossing_world`: each in turn."""
    return np.zeros(count, np.int32), np.arange(count, dtype=np.int32) % len(LANE_SEEDS)


def trial_config(c: Config) -> Config:
    """Return the configuration of trials: that of evaluation, without what training alone needs.

    So policies of one network share one compiled program.
    """
    base = Config()
    c = dataclasses.replace(c, run=base.run, ppo=base.ppo, curriculum=base.curriculum)
    c = dataclasses.replace(c, terrain=dataclasses.replace(c.terrain, name="flat"))
    return evaluation_config(c, TRIAL_SECONDS)


def block() -> int:
    """Return how many robots a device steps together in trials; assumed: fills it."""
    return 100 if jax.default_backend() == "cpu" else 1000


def starts(world: World, seed: int, count: int) -> rollout.Robots:
    """Return the robots as the trials of this seed begin in `crossing_world`."""
    return trials.begin(world, seed, np.arange(count), *crossing_lanes(count))


@jax.jit(static_argnames=("episodes", "steps"))
def _episodes(
    world: World, train: ppo.TrainState, key: PRNGKeyArray, episodes: int, steps: int
) -> tuple[Ending, _Step]:
    """Return each robot's first end, and its steps [T, E] up to there."""
    nets = rollout.networks(world.config.network, len(world.physics.robot.joint_names))
    robots = rollout.start(world, key, episodes)
    robots = robots.replace(env=robots.env.replace(step=jnp.zeros_like(robots.env.step)))

    def step(
        carry: tuple[rollout.Robots, Bool[Array, " E"]], _: None
    ) -> tuple[tuple[rollout.Robots, Bool[Array, " E"]], tuple[Ending, _Step]]:
        before, alive = carry
        memory, policy = rollout.policy_step(nets, train, before)
        robots, outcome = rollout.env_step(world, before, memory, policy.mean[0])
        measures, ending = outcome.measures, outcome.ending
        counted = Ending(*(flag & alive for flag in ending))
        seen = _Step(
            alive=alive,
            forward_speed=measures.forward_speed,
            forward_error=measures.forward_command - measures.forward_speed,
            tracking_error=measures.speed_error,
            airborne=measures.airborne,
            y=before.env.body.qpos[:, 1],
        )
        return (robots, alive & ~ending.terminated & ~ending.truncated), (counted, seen)

    first = (robots, jnp.ones(episodes, bool))
    _, (endings, trace) = jax.lax.scan(step, first, None, length=steps)
    return Ending(*(flag.any(axis=0) for flag in endings)), trace


def _by_cause(ending: Ending) -> dict[str, int]:
    """Return how many robots fell in each way; one that did in several counts for the first."""
    flags = np.stack([getattr(ending, name) for name in trials.FALLS])
    first = np.where(flags.any(axis=0), flags.argmax(axis=0), -1)
    return {name: int((first == k).sum()) for k, name in enumerate(trials.FALLS)}


def _judged(ending: Ending, trace: _Step, c: Config) -> Walk:
    alive, lived = trace.alive, np.maximum(trace.alive.sum(axis=0), 1)
    of_episode = lambda x: np.sum(x * alive, axis=0) / lived
    both = trace.alive[..., None]
    airborne = np.sum(trace.airborne * both, axis=(0, 1)) / np.maximum(alive.sum(), 1)
    touchdowns = (trace.airborne[:-1] & ~trace.airborne[1:] & both[1:]).sum()
    seconds = 2 * alive.sum() * c.physics.control_period  # of foot and robot
    return Walk(
        episodes=alive.shape[1],
        fell=int(ending.terminated.sum()),
        by_cause=_by_cause(ending),
        speed_error=float(np.abs(of_episode(trace.forward_error)).mean()),
        tracking_error=float(of_episode(trace.tracking_error).mean()),
        airborne=(float(airborne[0]), float(airborne[1])),
        step_seconds=float(seconds / max(touchdowns, 1)),
        sideways=sideways.summed(*sideways.spans(trace.y, alive)),
    )
