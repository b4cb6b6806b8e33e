"""Manifest of an exported policy: everything but the weights, with units and frames."""

import dataclasses
import datetime
import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from cref_jax import config, deploy, network, ppo, robot
from cref_jax.config import Config
from cref_jax.env import observations
from cref_jax.policy.trained import TrainedPolicy
from cref_jax.training import distillation, run_dir

HOLD_STEPS = 5  # assumed: 0.1 s on the last target, then the robot is let down
STALE = 0.1  # s, two camera frames
MOST_INVALID = 0.5  # share of a frame's pixels; assumed: beyond it, the last frame tells more


def build_manifest(policy: TrainedPolicy, driven: robot.Robot) -> dict[str, Any]:
    """Build everything but the weights, without digests."""
    c = robot.fill_in(policy.config)
    return {
        "format": "cref-policy",
        "schema": deploy.SCHEMA,
        "robot": c.robot.name,
        "rates": {
            "control_hz": 1.0 / c.physics.control_period,
            "depth_hz": c.camera.rate,
            "frame_age_s": c.physics.control_period,
        },
        "joints": _joints(driven),
        "held_joints": _held_joints(c, driven),
        "legs": _legs(c, driven),
        "action": _action(c),
        "observation": _observation(policy.train, driven),
        "command": _command(c),
        "depth": _depth(c) if c.network.sees else None,
        "network": _network(c.network),
        "state": _state(c.network),
        "guards": _guards(driven),
        "provenance": _provenance(policy),
        "evaluation": _evaluation(policy.run),
    }


def _joints(driven: robot.Robot) -> list[dict[str, Any]]:
    """List the joints that the policy drives, in the order of every array."""
    columns = {
        "default_rad": driven.nominal_pose,
        "action_scale_rad": driven.action_scale,
        "low_rad": driven.range_low,
        "high_rad": driven.range_high,
        "velocity_rad_s": driven.velocity_limit,
        "kp": driven.kp,
        "kd": driven.kd,
        "effort_nm": driven.effort,
    }
    return [
        {"name": name, **{key: float(values[j]) for key, values in columns.items()}}
        for j, name in enumerate(driven.joint_names)
    ]


def _held_joints(c: Config, driven: robot.Robot) -> list[dict[str, Any]]:
    """List the joints that the robot must hold at their default."""
    whole = robot.load(dataclasses.replace(c.robot, actuated="all"))
    keys = ("name", "default_rad", "kp", "kd", "effort_nm")
    return [
        {key: joint[key] for key in keys}
        for joint in _joints(whole)
        if joint["name"] not in driven.joint_names
    ]


def _legs(c: Config, driven: robot.Robot) -> list[dict[str, Any]]:
    """List the joints from the base to each foot; axes in the base's frame, all joints at 0."""
    model = robot.spec(robot.moving(c.robot), c.physics, 0, name=c.robot.name).compile()
    upright = mujoco.MjData(model)
    upright.qpos[:] = 0.0
    upright.qpos[3] = 1.0
    mujoco.mj_kinematics(model, upright)
    legs = []
    for foot in driven.ankles:
        joints = []
        while foot != driven.pelvis:
            joints.insert(0, int(model.body_jntadr[foot]))
            foot = int(model.body_parentid[foot])
        legs.append(joints)
    axis = lambda joint: [float(round(x, 9)) for x in upright.xaxis[joint]]
    return [
        {"joints": [{"name": model.joint(j).name, "axis": axis(j)} for j in joints]}
        for joints in legs
    ]


def _action(c: Config) -> dict[str, Any]:
    return {
        "clip": c.robot.action_clip,
        "formula": "target = default_rad + action_scale_rad * clip(action, -clip, clip)",
        "torque": "clip(kp (target - q) - kd qd, -effort_nm, effort_nm)",
    }


def _observation(train: ppo.TrainState, driven: robot.Robot) -> dict[str, Any]:
    joints, statistics = driven.num_joints, train.statistics.obs
    return {
        "terms": [part._replace(size=part.size or joints)._asdict() for part in observations.PARTS],
        "formula": "clip((x - mean) / std, -clip, clip)",
        "mean": [float(x) for x in np.asarray(statistics.mean, np.float32)],
        "std": [float(x) for x in np.asarray(statistics.std, np.float32)],
        "clip": ppo.OBSERVATION_CLIP,
    }


def _command(c: Config) -> dict[str, Any]:
    """Compute the range of the trained commands, on open ground and along lanes."""
    turn = max(c.command.lane_yaw_rate, *map(abs, c.command.yaw_rate))
    forward = (*c.command.vx, *c.command.lane_vx)
    return {
        "low": [min(forward), c.command.vy[0], -turn],
        "high": [max(forward), c.command.vy[1], turn],
    }


def _depth(c: Config) -> dict[str, Any]:
    whole = dataclasses.replace(c.robot, actuated="all")
    mount = robot.load(whole).camera
    model = robot.spec("all", c.physics, contact_planes=0, name=c.robot.name).compile()
    rows, columns = c.camera.shape
    return {
        "rows": rows,
        "columns": columns,
        "view_deg": {"vertical": c.camera.view[0], "horizontal": c.camera.view[1]},
        "orientation": "row 0 is the top, column 0 the left; depth along the optical axis, m",
        "mount": {
            "link": model.body(mount.body).name,
            "position_m": [float(x) for x in mount.position],
            "rotation_wxyz": [float(x) for x in mount.rotation],
            "pitch_deg": c.camera.pitch,
        },
        "d_max_m": c.camera.d_max,
        "range": "a depth beyond d_max_m, infinity as well, reads as d_max_m",
        "invalid": "where depth is 0, negative or NaN, 1 / depth is interpolated linearly between"
        " the nearest known pixels of its row, and is that of the outermost beyond them; a row"
        " without known pixels likewise between the nearest rows with some; if more than"
        " guards.max_invalid of the pixels are unknown, the frame is not used",
        "window": c.camera.window,
        "resize": "the pixel that the middle of each cell falls into, of an image with this view; a"
        " RealSense D435i has it at 848 x 480, not at 640 x 480, which shows 75 x 62 degrees: of"
        " that a cell takes the pixel at the same tangents from the optical axis, and one outside"
        " it is 0, invalid",
        "formula": "float16(nearest / d_max_m - 0.5), nearest: the smallest depth of the window x"
        " window pixels around, fewer at the border, after range and invalid",
    }


def _network(c: config.Network) -> dict[str, Any]:
    keys = ("channels", "kernel", "stride")
    of_variant = {"depth_mlp": list(network.DEPTH_MLP)} if c.variant == "hpl" else {}
    return {
        "variant": c.variant,
        "convolutions": [dict(zip(keys, layer, strict=True)) for layer in c.convolutions],
        "token": c.token,
        "heads": c.heads,
        "compressed": c.compressed,
        "lstm": c.lstm,
        "gru": c.gru,
        "actor": list(c.actor),
        "activation": "elu",
        "norm_epsilon": 1e-6,
        **of_variant,
    }


def _state(c: config.Network) -> dict[str, Any]:
    return {
        "lstm_c": [c.lstm],
        "lstm_h": [c.lstm],
        "gru": [c.gru],
        "reset": "all zero, and no frame",
    }


def _guards(driven: robot.Robot) -> dict[str, Any]:
    """Compute the runtime's limits; those on targets exclude only what the motors cannot do.

    A target further than this from the pose asks for no more torque, at any speed.
    """
    reach = [float(x) for x in (driven.effort + driven.kd * driven.velocity_limit) / driven.kp]
    return {
        "hold_steps": HOLD_STEPS,
        "stale_s": STALE,
        "max_invalid": MOST_INVALID,
        "rate_rad": [2.0 * x for x in reach],
        "beyond_rad": reach,
    }


def _provenance(policy: TrainedPolicy) -> dict[str, Any]:
    """Describe the origin of the policy; the last start of its run represents all of them."""
    c = policy.config
    stages = distillation.samples_by_stage(c, policy.iteration)
    start = [{}, *run_dir.read_starts(policy.run)][-1]
    start["command"] = [_strip_folders(word) for word in start.get("command", [])]
    settings = json.loads(json.dumps(dataclasses.asdict(c)))
    taught = settings["distillation"]
    taught["teachers"] = [_strip_folders(word) for word in taught["teachers"]]
    return {
        "exported": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "run": policy.run.name,
        "iteration": policy.iteration,
        "samples": policy.samples,
        **({"samples_by_stage": stages} if stages else {}),
        "trained_by": start,
        "config": settings,
    }


def _strip_folders(word: str) -> str:
    """Strip private folders from a word of the command line, or from what it gives a value to."""
    name, equals, value = word.rpartition("=")
    return name + equals + (Path(value).name if Path(value).is_absolute() else value)


def _evaluation(run: Path) -> dict[str, Any] | None:
    """Read the run's latest eval.json, if there is one."""
    path = run / "eval.json"
    return json.loads(path.read_text()) if path.is_file() else None
