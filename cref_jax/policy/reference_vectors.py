"""What the network said in training, tensor by tensor, for a policy elsewhere to be held against.

The inputs are those of real steps; the expected tensors are computed by the network that was
trained, from these inputs alone.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float16

from cref_jax import config, depth, network, ppo
from cref_jax.env import observations
from cref_jax.env.world import World
from cref_jax.robot import Robot
from cref_jax.training import rollout

STEPS = 64  # of the test vectors, in two episodes of half as many
HOLES = (slice(8, 16), slice(20, 44))  # rows and columns of one frame that are 0, or NaN below
HOLED = -2  # which of the frames


class Recorded(NamedTuple):
    """T control steps of one robot as its sensors report them, SI units."""

    angular_velocity: Float[Array | np.ndarray, "T 3"]
    gravity: Float[Array | np.ndarray, "T 3"]
    command: Float[Array | np.ndarray, "T 3"]
    q: Float[Array | np.ndarray, "T J"]
    qd: Float[Array | np.ndarray, "T J"]
    reset: Bool[Array | np.ndarray, " T"]  # the step is the first of an episode
    image: Float16[Array | np.ndarray, "T H W"] | None  # D, the frame at hand; None: blind
    fresh: Bool[Array | np.ndarray, " T"]  # it has come since the step before


class _Held(NamedTuple):
    """What passes from one step to the next."""

    carry: network.Carry
    features: network.Features | None
    seen: Bool[Array, " 1"]
    action: Float[Array, " J"]


def test_vectors(world: World, train: ppo.TrainState) -> dict[str, np.ndarray]:
    """Return the arrays of testvectors.npz: inputs, frames in metres, and `expect/` tensors."""
    c, period = world.config, world.config.physics.control_period
    halves = [record(world, train, STEPS // 2, jax.random.key(seed)) for seed in (0, 1)]
    steps = jax.tree.map(lambda *x: np.concatenate(x), *halves)
    now = np.arange(STEPS) * period
    vectors = {**steps._asdict(), "now": now}
    if steps.image is not None:
        at = np.flatnonzero(steps.fresh)
        image = steps.image.copy()
        image[at[HOLED]] = image[at[HOLED]].mean(axis=1, keepdims=True)  # so a hole tells nothing
        metres = (image[at].astype(np.float32) + 0.5) * np.float32(c.camera.d_max)
        metres[HOLED][HOLES] = 0.0
        metres[HOLED][HOLES[0].stop :, HOLES[1]] = np.nan
        near = jax.vmap(functools.partial(depth.nearest_around, window=c.camera.window))
        steps = steps._replace(image=np.asarray(near(jnp.asarray(image))))  # of these frames
        vectors |= {"frames": metres, "frame_step": at, "stamps": now[at] - period}
    else:
        none = np.zeros(0)
        vectors |= {"frames": none, "frame_step": none.astype(int), "stamps": none}
    expected = reference(c.network, train, world.physics.robot, c.robot, steps)
    given = {k: v for k, v in vectors.items() if k not in ("image", "fresh")}
    return given | {f"expect/{name}": np.asarray(x) for name, x in expected.items()}


def record(world: World, train: ppo.TrainState, steps: int, key: Array) -> Recorded:
    """Return what one robot's sensors report while the policy walks it from a lane's start."""
    where = observations.slices(len(world.physics.robot.joint_names))
    nominal = world.physics.robot.nominal_pose

    def step(robots: rollout.Robots, _: None) -> tuple[rollout.Robots, Recorded]:
        nets, feed = rollout.networks(world.config.network, len(nominal)), robots.feed
        memory, policy = rollout.policy_step(nets, train, robots)
        after, _outcome = rollout.env_step(world, robots, memory, policy.mean[0])
        part = {name: robots.observation.proprioception[0, at] for name, at in where.items()}
        return after, Recorded(
            angular_velocity=part["angular_velocity"],
            gravity=part["gravity"],
            command=part["command"],
            q=part["joint_position"] + nominal,
            qd=part["joint_velocity"],
            reset=robots.begins[0],
            image=None if feed is None else feed.images(world.config.network)[0],
            fresh=jnp.zeros((), bool) if feed is None else feed.fresh & feed.seen[0],
        )

    robots = rollout.start(world, key, 1)
    robots = robots.replace(env=robots.env.replace(step=jnp.zeros_like(robots.env.step)))
    walk = jax.jit(lambda robots: jax.lax.scan(step, robots, None, length=steps)[1])
    return jax.tree.map(np.asarray, walk(robots))


def reference(
    c: config.Network,
    train: ppo.TrainState,
    robot: Robot,
    limits: config.Robot,
    steps: Recorded,
) -> dict[str, Array]:
    """Return what the trained network holds and says after each step, by the names of deploy.py."""
    actor = network.Actor(c, len(robot.joint_names))
    start = _Held(
        carry=network.initial_carry(c, 1),
        features=None,
        seen=jnp.zeros(1, bool),
        action=jnp.zeros(len(robot.joint_names)),
    )
    if steps.image is not None:
        start = start._replace(features=network.no_features(c, steps.image.shape[1:], 1))
    step = functools.partial(_reference_step, actor, train, robot, limits)
    return jax.jit(lambda steps: jax.lax.scan(step, start, steps)[1])(steps)


def _reference_step(
    actor: network.Actor,
    train: ppo.TrainState,
    robot: Robot,
    limits: config.Robot,
    held: _Held,
    step: Recorded,
) -> tuple[_Held, dict[str, Array]]:
    """Return what is held after a step, and every tensor of the way there."""
    params, begins = train.params.actor, step.reset[None]
    previous = jnp.where(begins, 0.0, held.action)
    parts = (step.angular_velocity, step.gravity, step.command)
    obs = jnp.concatenate([*parts, step.q - robot.nominal_pose, step.qd, previous])
    obs = ppo.normalise(train.statistics.obs, obs)
    view, features, seen = None, held.features, held.seen & ~begins | step.fresh
    if features is not None:
        frame = network.in_patches(actor.c, jnp.asarray(step.image)[None, None])
        encode = lambda: actor.apply(params, frame, method="encode")
        emptied = jax.tree.map(lambda x: jnp.where(begins[0], 0.0, x), features)
        features = jax.lax.cond(step.fresh, encode, lambda: emptied)
        view = network.View(features, jnp.zeros((1, 1), jnp.int32), seen[None])
    (carry, output), captured = actor.apply(
        params, held.carry, obs[None, None], begins[None], view,
        method="decide", capture_intermediates=True, mutable="intermediates",
    )  # fmt: skip
    action = jnp.clip(output.mean[0, 0], -limits.action_clip, limits.action_clip)
    part = {name: made["__call__"][0] for name, made in captured["intermediates"].items()}
    tensors = {
        "velocity": output.velocity,
        "state_token": part["proprioceptive_tokenizer"],
        "fused": part["fusion"],
        "blended": part["recurrent_fusion"][1],
        "gate": output.gate,
        "action": output.mean,
        "lstm_c": carry.lstm_c[None],
        "lstm_h": carry.lstm_h[None],
        "gru": carry.gru[None],
        "previous_action": action[None, None],
        "target": (robot.nominal_pose + robot.action_scale * action)[None, None],
        **_sensed(features, seen, part, output),
    }
    return _Held(carry, features, seen, action), {k: x[0, 0] for k, x in tensors.items()}


def _sensed(
    features: network.Features | None,
    seen: Bool[Array, " 1"],
    part: dict[str, Any],
    output: network.Output,
) -> dict[str, Array]:
    """Return the tensors of what is seen, which are zero before the first frame."""
    if features is None:
        return {}
    made = part["cross_attention"][0] if "cross_attention" in part else part["pooled_tokens"][0]
    found = {"compressed": features.compressed, "depth_token": made}
    if output.attention is not None:
        found["attention"] = output.attention
    return {"tokens": features.tokens} | {k: jnp.where(seen, x, 0.0) for k, x in found.items()}
