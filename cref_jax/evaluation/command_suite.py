"""Command tracking on level ground: standing, walking, turning and stopping."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from rich.table import Table

from cref_jax import geometry, ppo
from cref_jax.config import Config
from cref_jax.env import observations
from cref_jax.env.world import World, make_world
from cref_jax.evaluation import protocol, trials
from cref_jax.physics.simulation import Physics
from cref_jax.terrain import lanes
from cref_jax.training import rollout

SECONDS = 10.0  # per trial; assumed
SETTLING = 2.0  # s to come to rest or up to speed; assumed
STAND = (0.0, 0.0, 0.0)
GRID = (  # m/s forward, m/s to the left, rad/s to the left
    STAND,
    *((vx, 0.0, 0.0) for vx in (0.2, 0.4, 0.6, 0.8, 1.0)),
    *((0.0, vy, 0.0) for vy in (-0.3, 0.3)),
    *((0.0, 0.0, rate) for rate in (-1.0, -0.5, 0.5, 1.0)),
)
STOP = (0.6, 0.0, 0.0)  # before the command to stop
WALKS = 5.0  # s of walking before that command; assumed
DRIFT = 0.05  # m that a standing robot may move; assumed
LANE = 16.0
"""m, at least: at the lane's end a robot is put back. The fastest command, for `SECONDS` and by
30 % too fast, takes 13 m; a robot starts up to 1 m from one end, and 1 m before the other it is
there."""


class CommandTrace(NamedTuple):
    """Motion of E robots over T control steps."""

    position: Float[Array | np.ndarray, "T E 2"]  # m, world
    velocity: Float[Array | np.ndarray, "T E 3"]  # m/s forward and to the left, rad/s; body frame
    touchdown: Bool[Array | np.ndarray, "T E F"]
    airborne: Bool[Array | np.ndarray, "T E F"]
    fallen: Bool[Array | np.ndarray, "T E"]  # in this step or earlier


def run_commands(
    c: Config, physics: Physics, train: ppo.TrainState, count: int, seed: int
) -> dict[str, Any]:
    """Run `count` trials per command, and `count` trials of the command to stop."""
    commands = np.repeat(np.array([*GRID, STOP], np.float32), count, axis=0)
    steps = round(SECONDS / c.physics.control_period)
    stop = np.full(len(commands), steps)
    stop[-count:] = round(WALKS / c.physics.control_period)
    world, number = _flat_world(c, physics), np.arange(len(commands))
    robots = trials.start_robots(world, seed, number, 0 * number, 0 * number)
    trace = _record_trace(world, train, robots, jnp.asarray(commands), jnp.asarray(stop), steps)
    trace = CommandTrace(*map(np.asarray, trace))
    period = c.physics.control_period
    of = lambda k: CommandTrace(*(x[:, k * count : (k + 1) * count] for x in trace))
    rows = [summarize_command(of(k), command, period) for k, command in enumerate(GRID)]
    return {"commands": rows, "stop": summarize_stop(of(len(GRID)), period)}


def summarize_command(
    trace: CommandTrace, command: tuple[float, float, float], period: float
) -> dict[str, Any]:
    """Compute how well one command was tracked after `SETTLING` s, by the robots still upright."""
    first, upright = round(SETTLING / period), ~trace.fallen[-1]
    mean = trace.velocity[first:].mean(axis=0)[upright]  # [E, 3]
    farthest = np.linalg.norm(trace.position - trace.position[0], axis=-1).max(axis=0)
    steps = trace.touchdown[first:].any(axis=(0, 2))
    airborne = trace.airborne[first:].mean(axis=0)[upright]
    all_fell = not upright.any()
    result: dict[str, Any] = {
        "command": list(command),
        "trials": int(upright.size),
        "fell": int((~upright).sum()),
        "velocity": None if all_fell else mean.mean(axis=0).tolist(),
        "error": None if all_fell else np.abs(mean - command).mean(axis=0).tolist(),
        "airborne": None if all_fell else airborne.mean(axis=0).tolist(),
    }
    if command == STAND:
        result |= {
            "stood": int((upright & (farthest < DRIFT)).sum()),
            "still": int((upright & ~steps).sum()),
            "drift_m": None if all_fell else float(np.median(farthest[upright])),
        }
    return result


def summarize_stop(trace: CommandTrace, period: float) -> dict[str, Any]:
    """Compute the distance from the command to stop until the end of the trial, m."""
    last, upright = round(WALKS / period) - 1, ~trace.fallen[-1]  # step before that command
    distance = np.linalg.norm(trace.position[-1] - trace.position[last], axis=-1)[upright]
    return {
        "trials": int(upright.size),
        "fell": int((~upright).sum()),
        "distance_m": float(np.median(distance)) if distance.size else None,
    }


def to_table(result: dict[str, Any]) -> Table:
    """Build the table for the terminal."""
    table = Table(box=None, padding=(0, 1))
    for column in ("command", "velocity", "error", "fell", "feet up, %"):
        table.add_column(column, justify="right", no_wrap=True)
    numbers = lambda values, form: "" if values is None else " ".join(form % x for x in values)
    for r in result["commands"]:
        air = numbers(r["airborne"] and [100.0 * x for x in r["airborne"]], "%.0f")
        parts = ((r["command"], "%4.1f"), (r["velocity"], "%5.2f"), (r["error"], "%4.2f"))
        table.add_row(*(numbers(*part) for part in parts), f"{r['fell']} of {r['trials']}", air)
    table.caption = "m/s forward, m/s to the left, rad/s to the left; feet: left, right"
    return table


def describe(result: dict[str, Any]) -> str:
    """Describe in words how the robot stands and stops."""
    stand = next(r for r in result["commands"] if tuple(r["command"]) == STAND)
    stop, metres = result["stop"], lambda x: "-" if x is None else f"{x:.2f} m"
    return (
        f"standing for {SECONDS:.0f} s: {stand['stood']} of {stand['trials']} within "
        f"{100 * DRIFT:.0f} cm, {stand['still']} without a step after {SETTLING:.0f} s, median "
        f"drift {metres(stand['drift_m'])}\n"
        f"stopping from {STOP[0]} m/s: {metres(stop['distance_m'])} further, "
        f"{stop['fell']} of {stop['trials']} fell"
    )


def _flat_world(c: Config, physics: Physics) -> World:
    """Build a world with a flat lane on which no command is sampled."""
    terrain = dataclasses.replace(c.terrain, lane_length=max(LANE, c.terrain.lane_length))
    flat = lanes.build_grid(terrain, {"flat": (0.0,)}, (1,))
    return make_world(protocol.trial_config(c), physics).replace(lanes=flat)


@jax.jit(static_argnames="steps")
def _record_trace(
    world: World,
    train: ppo.TrainState,
    robots: rollout.Robots,
    commands: Float[Array, "E 3"],
    stop: Int[Array, " E"],
    steps: int,
) -> CommandTrace:
    """Walk the robots with these commands, and with the one to stand from step `stop` on."""

    def step(carry: tuple[rollout.Robots, Bool[Array, " E"]], k: Int[Array, ""]) -> Any:
        robots, fallen = carry
        command = jnp.where((k < stop)[:, None], commands, 0.0)
        robots = _set_command(robots, command)
        robots, _policy, outcome = rollout.step_policy(world, train, robots)
        fallen = fallen | outcome.ending.terminated
        body = robots.env.body
        ahead = jax.vmap(geometry.rotate_inverse)(body.qpos[:, 3:7], body.qvel[:, :3])[:, :2]
        velocity = jnp.concatenate([ahead, body.qvel[:, 5:6]], axis=1)
        trace = CommandTrace(
            body.qpos[:, :2],
            velocity,
            outcome.measures.touchdown,
            outcome.measures.airborne,
            fallen,
        )
        return (robots, fallen), trace

    return jax.lax.scan(step, (robots, jnp.zeros(len(commands), bool)), jnp.arange(steps))[1]


def _set_command(robots: rollout.Robots, command: Float[Array, "E 3"]) -> rollout.Robots:
    """Set the robots' command, in their state and in their observation."""
    env = robots.env.replace(command=command, is_steered=jnp.zeros(len(command), bool))
    observation = robots.observation
    obs = observation.proprioception
    where = observations.slices(observations.num_joints_of(obs.shape[1]))["command"]
    told = observation._replace(proprioception=obs.at[:, where].set(command))
    return robots.replace(env=env, observation=told)
