"""Reference inputs and tensors of the trained network, to verify an exported policy.

The inputs come from simulated steps; the trained network computes the expected tensors from these
inputs alone.
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

STEPS = 64  # of the test vectors, in two episodes of equal length
HOLES = (slice(8, 16), slice(20, 44))  # rows and columns of one frame: 0, and NaN below
HOLED = -2  # index of that frame


class SensorLog(NamedTuple):
    """Sensor readings of one robot over T control steps, SI units."""

    angular_velocity: Float[Array | np.ndarray, "T 3"]
    gravity: Float[Array | np.ndarray, "T 3"]
    command: Float[Array | np.ndarray, "T 3"]
    q: Float[Array | np.ndarray, "T J"]
    qd: Float[Array | np.ndarray, "T J"]
    reset: Bool[Array | np.ndarray, " T"]  # first step of an episode
    image: Float16[Array | np.ndarray, "T H W"] | None  # D, latest frame; None: blind
    fresh: Bool[Array | np.ndarray, " T"]  # the frame has come since the step before


class _StepState(NamedTuple):
    """State carried from one step to the next."""

    carry: network.Carry
    features: network.Features | None
    frame_valid: Bool[Array, " 1"]
    action: Float[Array, " J"]


def build_test_vectors(world: World, train: ppo.TrainState) -> dict[str, np.ndarray]:
    """Compute the arrays of testvectors.npz: inputs, frames in metres, and `expect/` tensors.

    Nothing is randomised: the runtime could take errors of sensors for faults.
    """
    c, period = world.config, world.config.physics.control_period
    calm = world.replace(config=config.override(c, {"randomisation": {"enabled": False}}))
    episodes = [record_sensors(calm, train, STEPS // 2, jax.random.key(seed)) for seed in (0, 1)]
    steps = jax.tree.map(lambda *x: np.concatenate(x), *episodes)
    now = np.arange(STEPS) * period
    vectors = {**steps._asdict(), "now": now}
    if steps.image is not None:
        at = np.flatnonzero(steps.fresh)
        image = steps.image.copy()
        image[at[HOLED]] = image[at[HOLED]].mean(
            axis=1, keepdims=True
        )  # constant rows: a hole hides nothing
        metres = (image[at].astype(np.float32) + 0.5) * np.float32(c.camera.d_max)
        metres[HOLED][HOLES] = 0.0
        metres[HOLED][HOLES[0].stop :, HOLES[1]] = np.nan
        near = jax.vmap(functools.partial(depth.min_filter, window=c.camera.window))
        steps = steps._replace(
            image=np.asarray(near(jnp.asarray(image)))
        )  # computed from these frames
        vectors |= {"frames": metres, "frame_step": at, "stamps": now[at] - period}
    else:
        none = np.zeros(0)
        vectors |= {"frames": none, "frame_step": none.astype(int), "stamps": none}
    expected = compute_reference(c.network, train, world.physics.robot, c.robot, steps)
    given = {k: v for k, v in vectors.items() if k not in ("image", "fresh")}
    return given | {f"expect/{name}": np.asarray(x) for name, x in expected.items()}


def record_sensors(world: World, train: ppo.TrainState, steps: int, key: Array) -> SensorLog:
    """Record one robot's sensors while the policy walks it from a lane's start."""
    where = observations.slices(world.physics.robot.num_joints)
    nominal = world.physics.robot.nominal_pose

    def step(robots: rollout.Robots, _: None) -> tuple[rollout.Robots, SensorLog]:
        feed = robots.feed
        after, _policy, _outcome = rollout.step_policy(world, train, robots)
        part = {name: robots.observation.proprioception[0, at] for name, at in where.items()}
        return after, SensorLog(
            angular_velocity=part["angular_velocity"],
            gravity=part["gravity"],
            command=part["command"],
            q=part["joint_position"] + nominal,
            qd=part["joint_velocity"],
            reset=robots.begins[0],
            image=None if feed is None else feed.images(world.config.network)[0],
            fresh=jnp.zeros((), bool) if feed is None else feed.fresh & feed.seen[0],
        )

    robots = rollout.start(world, jax.random.split(key, 1))
    robots = robots.replace(env=robots.env.replace(step=jnp.zeros_like(robots.env.step)))
    walk = jax.jit(lambda robots: jax.lax.scan(step, robots, None, length=steps)[1])
    return jax.tree.map(np.asarray, walk(robots))


def compute_reference(
    c: config.Network,
    train: ppo.TrainState,
    robot: Robot,
    limits: config.Robot,
    steps: SensorLog,
) -> dict[str, Array]:
    """Compute the trained network's state and output after each step, named as in deploy.py."""
    actor = network.build_actor(c, robot.num_joints)
    start = _StepState(
        carry=network.initial_carry(c, 1),
        features=None,
        frame_valid=jnp.zeros(1, bool),
        action=jnp.zeros(robot.num_joints),
    )
    if steps.image is not None:
        start = start._replace(features=network.zero_features(c, steps.image.shape[1:], 1))
    step = functools.partial(_reference_step, actor, train, robot, limits)
    return jax.jit(lambda steps: jax.lax.scan(step, start, steps)[1])(steps)


def _reference_step(
    actor: network.Actor | network.ParkourActor,
    train: ppo.TrainState,
    robot: Robot,
    limits: config.Robot,
    state: _StepState,
    step: SensorLog,
) -> tuple[_StepState, dict[str, Array]]:
    """Compute the state after a step, and every intermediate tensor."""
    params, begins = train.params.actor, step.reset[None]
    previous = jnp.where(begins, 0.0, state.action)
    parts = (step.angular_velocity, step.gravity, step.command)
    obs = jnp.concatenate([*parts, step.q - robot.nominal_pose, step.qd, previous])
    obs = ppo.normalize(train.statistics.obs, obs)
    view, features = None, state.features
    frame_valid = state.frame_valid & ~begins | step.fresh
    if features is not None:
        frame = network.image_to_patches(actor.c, jnp.asarray(step.image)[None, None])
        encode = lambda: actor.apply(params, frame, method="encode")
        emptied = jax.tree.map(lambda x: jnp.where(begins[0], 0.0, x), features)
        features = jax.lax.cond(step.fresh, encode, lambda: emptied)
        view = network.EncodedInput(features, jnp.zeros((1, 1), jnp.int32), frame_valid[None])
    (carry, output), captured = actor.apply(
        params, state.carry, obs[None, None], begins[None], view,
        method="decide", capture_intermediates=True, mutable="intermediates",
    )  # fmt: skip
    action = jnp.clip(output.mean[0, 0], -limits.action_clip, limits.action_clip)
    part = {name: outputs["__call__"][0] for name, outputs in captured["intermediates"].items()}
    tensors = {
        "gate": output.gate,
        "action": output.mean,
        "gru": carry.gru[None],
        "previous_action": action[None, None],
        "target": (robot.nominal_pose + robot.action_scale * action)[None, None],
        **_inner_tensors(carry, features, frame_valid, part, output),
    }
    return _StepState(carry, features, frame_valid, action), {
        k: x[0, 0] for k, x in tensors.items()
    }


def _inner_tensors(
    carry: network.Carry,
    features: network.Features | None,
    frame_valid: Bool[Array, " 1"],
    part: dict[str, Any],
    output: network.Output,
) -> dict[str, Array]:
    """Collect the tensors that the variants do not have in common."""
    if features is not None and "proprioceptive_tokenizer" not in part:  # hpl's
        return {"compressed": jnp.where(frame_valid, features.compressed, 0.0)}
    return {
        "velocity": output.velocity,
        "state_token": part["proprioceptive_tokenizer"],
        "fused": part["fusion"],
        "blended": part["recurrent_fusion"][1],
        "lstm_c": carry.lstm_c[None],
        "lstm_h": carry.lstm_h[None],
        **_depth_tensors(features, frame_valid, part, output),
    }


def _depth_tensors(
    features: network.Features | None,
    frame_valid: Bool[Array, " 1"],
    part: dict[str, Any],
    output: network.Output,
) -> dict[str, Array]:
    """Collect the tensors of the depth branch, which are zero before the first frame."""
    if features is None:
        return {}
    depth_token = (
        part["cross_attention"][0] if "cross_attention" in part else part["pooled_tokens"][0]
    )
    tensors = {"compressed": features.compressed, "depth_token": depth_token}
    if output.attention is not None:
        tensors["attention"] = output.attention
    return {"tokens": features.tokens} | {
        k: jnp.where(frame_valid, x, 0.0) for k, x in tensors.items()
    }
