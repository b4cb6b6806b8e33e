"""How well a policy does what it is told on level ground: to stand, to walk, to turn, to stop."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from rich.table import Table

from cref_jax import geometry, ppo
from cref_jax.config import Config
from cref_jax.env.world import World, make_world
from cref_jax.evaluation import protocol, trials
from cref_jax.physics.simulation import Physics
from cref_jax.terrain import lanes
from cref_jax.training import rollout

SECONDS = 10.0  # of a trial; assumed
SETTLING = 2.0  # s that a robot has to come to rest or to speed; assumed
STAND = (0.0, 0.0, 0.0)
GRID = (  # m/s forward, m/s to the left, rad/s to the left
    STAND,
    *((vx, 0.0, 0.0) for vx in (0.2, 0.4, 0.6, 0.8, 1.0)),
    *((0.0, vy, 0.0) for vy in (-0.3, 0.3)),
    *((0.0, 0.0, rate) for rate in (-1.0, -0.5, 0.5, 1.0)),
)
STOP = (0.6, 0.0, 0.0)  # before a robot is told to stop
WALKS = 5.0  # s that it walks before; assumed
DRIFT = 0.05  # m that a robot that stands may move; assumed


class Trace(NamedTuple):
    """What E robots do at T control steps."""

    position: Float[Array | np.ndarray, "T E 2"]  # m, world
    velocity: Float[Array | np.ndarray, "T E 3"]  # m/s forward and to the left, rad/s; body
    touchdown: Bool[Array | np.ndarray, "T E F"]
    airborne: Bool[Array | np.ndarray, "T E F"]
    fallen: Bool[Array | np.ndarray, "T E"]  # in this step or before


def run_commands(
    c: Config, physics: Physics, train: ppo.TrainState, count: int, seed: int
) -> dict[str, Any]:
    """Judge `count` trials of each command, and as many of being told to stop."""
    told = np.repeat(np.array([*GRID, STOP], np.float32), count, axis=0)
    steps = round(SECONDS / c.physics.control_period)
    stop = np.full(len(told), steps)
    stop[-count:] = round(WALKS / c.physics.control_period)
    world, number = _world(c, physics), np.arange(len(told))
    robots = trials.begin(world, seed, number, 0 * number, 0 * number)
    seen = _obey(world, train, robots, jnp.asarray(told), jnp.asarray(stop), steps)
    seen = Trace(*map(np.asarray, seen))
    period = c.physics.control_period
    of = lambda k: Trace(*(x[:, k * count : (k + 1) * count] for x in seen))
    rows = [row(of(k), command, period) for k, command in enumerate(GRID)]
    return {"commands": rows, "stop": stopped(of(len(GRID)), period)}


def row(seen: Trace, command: tuple[float, float, float], period: float) -> dict[str, Any]:
    """Return how well one command was obeyed after `SETTLING` seconds, by those on their feet."""
    first, upright = round(SETTLING / period), ~seen.fallen[-1]
    mean = seen.velocity[first:].mean(axis=0)[upright]  # [E, 3]
    far = np.linalg.norm(seen.position - seen.position[0], axis=-1).max(axis=0)
    steps = seen.touchdown[first:].any(axis=(0, 2))
    airborne = seen.airborne[first:].mean(axis=0)[upright]
    nothing = not upright.any()
    found: dict[str, Any] = {
        "command": list(command),
        "trials": int(upright.size),
        "fell": int((~upright).sum()),
        "velocity": None if nothing else mean.mean(axis=0).tolist(),
        "error": None if nothing else np.abs(mean - command).mean(axis=0).tolist(),
        "airborne": None if nothing else airborne.mean(axis=0).tolist(),
    }
    if command == STAND:
        found |= {
            "stood": int((upright & (far < DRIFT)).sum()),
            "still": int((upright & ~steps).sum()),
            "drift_m": None if nothing else float(np.median(far[upright])),
        }
    return found


def stopped(seen: Trace, period: float) -> dict[str, Any]:
    """Return how far robots come after they are told to stop, m, until the end of the trial."""
    first, upright = round(WALKS / period), ~seen.fallen[-1]
    way = np.linalg.norm(seen.position[-1] - seen.position[first], axis=-1)[upright]
    return {
        "trials": int(upright.size),
        "fell": int((~upright).sum()),
        "distance_m": float(np.median(way)) if way.size else None,
    }


def text(found: dict[str, Any]) -> Table:
    """Return the table for the terminal."""
    table = Table(box=None, padding=(0, 1))
    for column in ("told", "does", "error", "fell", "feet up, %"):
        table.add_column(column, justify="right", no_wrap=True)
    numbers = lambda values, form: "" if values is None else " ".join(form % x for x in values)
    for r in found["commands"]:
        air = numbers(r["airborne"] and [100.0 * x for x in r["airborne"]], "%.0f")
        parts = ((r["command"], "%4.1f"), (r["velocity"], "%5.2f"), (r["error"], "%4.2f"))
        table.add_row(*(numbers(*part) for part in parts), f"{r['fell']} of {r['trials']}", air)
    table.caption = "m/s forward, m/s to the left, rad/s to the left; feet: left, right"
    return table


def lines(found: dict[str, Any]) -> str:
    """Return in words how the robot stands and stops."""
    stand = next(r for r in found["commands"] if tuple(r["command"]) == STAND)
    stop, metres = found["stop"], lambda x: "-" if x is None else f"{x:.2f} m"
    return (
        f"told to stand for {SECONDS:.0f} s: {stand['stood']} of {stand['trials']} within "
        f"{100 * DRIFT:.0f} cm, {stand['still']} without a step after {SETTLING:.0f} s, median "
        f"drift {metres(stand['drift_m'])}\n"
        f"told to stop at {STOP[0]} m/s: {metres(stop['distance_m'])} further, "
        f"{stop['fell']} of {stop['trials']} fell"
    )


def _world(c: Config, physics: Physics) -> World:
    """Return a flat lane on which no command is drawn."""
    flat = lanes.grid(c.terrain, {"flat": (0.0,)}, (1,))
    return make_world(protocol.trial_config(c), physics).replace(lanes=flat)


@jax.jit(static_argnames="steps")
def _obey(
    world: World,
    train: ppo.TrainState,
    robots: rollout.Robots,
    told: Float[Array, "E 3"],
    stop: Int[Array, " E"],
    steps: int,
) -> Trace:
    """Walk robots that are told this, and from step `stop` on to stand."""
    nets = rollout.networks(world.config.network, len(world.physics.robot.joint_names))

    def step(carry: tuple[rollout.Robots, Bool[Array, " E"]], k: Int[Array, ""]) -> Any:
        robots, fallen = carry
        command = jnp.where((k < stop)[:, None], told, 0.0)
        robots = _told(robots, command)
        memory, policy = rollout.policy_step(nets, train, robots)
        robots, outcome = rollout.env_step(world, robots, memory, policy.mean[0])
        fallen = fallen | outcome.ending.terminated
        body = robots.env.body
        ahead = jax.vmap(geometry.rotate_inverse)(body.qpos[:, 3:7], body.qvel[:, :3])[:, :2]
        velocity = jnp.concatenate([ahead, body.qvel[:, 5:6]], axis=1)
        seen = Trace(
            body.qpos[:, :2],
            velocity,
            outcome.measures.touchdown,
            outcome.measures.airborne,
            fallen,
        )
        return (robots, fallen), seen

    return jax.lax.scan(step, (robots, jnp.zeros(len(told), bool)), jnp.arange(steps))[1]


def _told(robots: rollout.Robots, command: Float[Array, "E 3"]) -> rollout.Robots:
    """Return the robots with another command, in what they see of it, too."""
    env = robots.env.replace(command=command, is_steered=jnp.zeros(len(command), bool))
    seen = robots.observation
    sees = seen.proprioception.at[:, 6:9].set(command)
    return robots.replace(env=env, observation=seen._replace(proprioception=sees))
