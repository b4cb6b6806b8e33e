"""What settings may be: the range of every number, and the relations between them.

The ranges exclude what cannot run, cannot learn or is a slip of the pen, and nothing else.
"""

import math

from cref_jax.config.learning import HPL
from cref_jax.config.ranges import Ranges, Rising, Samples, Within, check_ranges
from cref_jax.config.settings import Config
from cref_jax.errors import ConfigError

SHARE = Within(0, 1)
SECONDS = Within(0, 100)
SEED = Within(0, 2**32 - 1)  # JAX takes 32 bits of it
WIDTH = Within(1, 8192)  # of a layer
WEIGHT = Within(0, 1000)  # of a loss
GAIN = Within(0, 1000)  # weight of a term that is to be large
PENALTY = Within(-1000, 0)  # weight of a term that is to be small
CONTROL = Within(0.001, 0.1)  # s, period of control
LEAST_CELL = 0.01  # m; contact looks 3 cells far for a wall, and a shank has a radius of 2 cm
COMPRESSION = 8  # pixels, side of the blocks of the depth compression

RANGES: Ranges = {
    "run": {
        "num_envs": Within(1, 1_000_000),
        "iterations": Within(1, 10_000_000),
        "seed": SEED,
        "chunk": Within(1, 10_000),
        "checkpoint_minutes": Within(0, 10_000),
        "keep": Within(1, 10_000),
    },
    "robot": {
        "action_scale": Within(0.001, 100),
        "action_clip": Within(0.001, 1e6),
    },
    "physics": {
        "timestep": Within(1e-4, 0.02),
        "substeps": Within(1, 100),
        "iterations": Within(1, 1000),
        "line_search": Within(1, 1000),
        "velocity_limit": Within(1, 1e6),
    },
    "terrain": {
        "cell": Within(LEAST_CELL, 1),
        "lane_length": Within(1, 1000),
        "lane_width": Within(0.1, 1000),
        "levels": Within(1, 1000),
        "variants": Within(1, 1000),
        "slits": Within(0, 1),
        "seed": SEED,
    },
    "curriculum": {
        "up": SHARE,
        "down": SHARE,
        "start_level": Within(0, 1000),
        "review": SHARE,
    },
    "command": {
        "vx": Rising(-10, 10),
        "vy": Rising(-10, 10),
        "yaw_rate": Rising(-10, 10),
        "standing": SHARE,
        "zero": SHARE,
        "lane_free": SHARE,
        "period": Rising(0.1, 1e6),
        "lane_vx": Rising(-10, 10),
        "heading_gain": Within(0, 100),
        "lane_gain": Within(0, 100),
        "lane_yaw_rate": Within(0, 10),
    },
    "episode": {
        "length": Within(0.1, 1e6),
        "max_tilt": Within(0.01, 3.15),
        "min_height": Within(0, 10),
        "below_edge": Within(0, 100),
        "stall_time": Within(0, 1e6),
        "start_x": Rising(0, 1000),
        "start_anywhere": SHARE,
        "start_y": Rising(-1000, 1000),
        "lane_end": Within(0, 1000),
        "yaw_jitter": Within(0, 3.15),
        "bank_size": Within(1, 100_000),
        "settle_time": Within(0, 100),
    },
    "randomisation": {
        "friction": Rising(0.01, 10),
        "trunk_mass": Within(0, 100),
        "trunk_com": Within(0, 1),
        "gains": Rising(0.01, 100),
        "joint_offset": Within(0, 1),
        "action_delay": Within(0, 1),
        "push_velocity": Within(0, 10),
        "push_period": Rising(0.1, 1e6),
        "noise_angular_velocity": Within(0, 100),
        "noise_gravity": Within(0, 10),
        "noise_joint_position": Within(0, 10),
        "noise_joint_velocity": Within(0, 100),
        "camera_pitch": Within(0, 90),
        "camera_position": Within(0, 1),
        "structures": Within(0, 1000),
        "perforations": Within(0, 1),
        "depth_noise": Within(0, 1),
        "depth_scale": Within(0, 0.9),
        "depth_dead": Within(0, 0.9),
        "depth_holes": Within(0, 0.5),
        "narrow_view": Within(0, 1),
        "push_yaw_rate": Within(0, 100),
        "undisturbed": Within(0, 1),
        "pushed_alone": Within(0, 1),
        "ramp_falls": Rising(0, 1e6),
        "ramp_step": Within(0, 1),
    },
    "reward": {
        "weights": {
            "linear_velocity_tracking": GAIN,
            "angular_velocity_tracking": GAIN,
            "orientation": GAIN,
            "feet_contact": GAIN,
            "feet_y_distance": GAIN,
            "foothold_placement": GAIN,
            "foothold_missed": PENALTY,
            "foot_contact_quality": PENALTY,
            "base_height": GAIN,
            "linear_velocity_z": PENALTY,
            "angular_velocity_xy": PENALTY,
            "joint_velocity": PENALTY,
            "action_rate": PENALTY,
            "action_smoothness": PENALTY,
            "feet_air_time": PENALTY,
            "air_time_variance": PENALTY,
            "foot_up_when_standing": PENALTY,
            "foot_slip": PENALTY,
            "foot_impact_acceleration": PENALTY,
            "foot_impact_velocity": PENALTY,
            "joint_position_limits": PENALTY,
            "joint_velocity_limits": PENALTY,
            "hip_position": PENALTY,
            "ankle_position": PENALTY,
            "stumble": PENALTY,
            "wall_contact": PENALTY,
        },
        "event_time": SECONDS,
        "debounce": Within(1, 1000),
        "sigma_v": Within(1e-6, 1e6),
        "sigma_omega": Within(1e-6, 1e6),
        "low_speed": Within(0, 100),
        "standing": Within(0, 100),
        "single_contact_window": SECONDS,
        "feet_y_target": Within(0, 10),
        "foothold_tolerance": Within(0.001, 10),
        "base_height_target": Within(0, 10),
        "support_force": Within(0, 1e6),
        "contact_force": Within(0, 1e6),
        "air_time_target": SECONDS,
        "impact_acceleration": Within(0, 1e6),
        "impact_velocity": Within(0, 1e6),
        "stumble_ratio": Within(0, 1e6),
        "soft_limit": SHARE,
    },
    "scan": {
        "x": Samples(-10, 10),
        "y": Samples(-10, 10),
        "ahead": Samples(-10, 10),
        "teacher_x": Samples(-10, 10),
        "teacher_y": Samples(-10, 10),
        "base_height": Within(0, 10),
        "clip": Within(0.001, 1000),
    },
    "camera": {
        "shape": Within(1, 4096),
        "view": Within(1, 179),
        "d_max": Within(0.1, 100),
        "pitch": Within(-90, 90),
        "rate": Within(0.1, 1000),
        "window": Within(1, 99),
    },
    "foothold": {
        "points": Within(1, 10_000),
        "spacing": Within(0.001, 1),
        "window": Within(1, 10_000),
        "stride": Within(1, 1000),
        "gate_time": Within(0, 100),
        "min_points": Within(1, 1_000_000),
        "roughness": Within(0, 10),
        "verticality": SHARE,
        "min_height": Within(-100, 100),
        "quality_x": Samples(-1, 1),
        "quality_y": Samples(-1, 1),
        "quality_depth": Within(-10, 10),
    },
    "network": {
        "convolutions": Within(1, 1024),
        "token": WIDTH,
        "heads": Within(1, 256),
        "compressed": WIDTH,
        "lstm": WIDTH,
        "gru": WIDTH,
        "actor": WIDTH,
        "critic": WIDTH,
        "initial_std": Within(0.001, 10),
        "min_std": Within(0, 10),
    },
    "ppo": {
        "horizon": Within(1, 10_000),
        "epochs": Within(1, 100),
        "minibatches": Within(1, 10_000),
        "clip": Within(0.001, 100),
        "value_clip": Within(0, 1e6),
        "value_weight": WEIGHT,
        "entropy_weight": WEIGHT,
        "estimator_weight": WEIGHT,
        "readout_weight": WEIGHT,
        "mirror_weight": WEIGHT,
        "imitation_weight": WEIGHT,
        "gamma": SHARE,
        "lam": SHARE,
        "learning_rate": Within(1e-8, 1),
        "learning_rate_range": Rising(1e-8, 1),
        "critic_learning_rate": Within(0, 1),
        "target_kl": Within(1e-6, 10),
        "max_gradient_norm": Within(1e-6, 1e6),
        "average": Within(0, 1_000_000),
        "critic_first": Within(0, 1_000_000),
    },
    "distillation": {
        "teacher_iterations": Within(0, 10_000_000),
        "learning_rate": Within(1e-8, 1),
    },
}


def check(c: Config) -> None:
    """Refuse settings that cannot run, or could only do something else than what they say.

    Raises:
        ConfigError: says which setting, and what would be right.
    """
    check_ranges(c, RANGES)
    _check_minibatches(c)
    _check_times(c)
    _check_learning_rate(c)
    _check_shares(c)
    _check_footholds(c)
    _check_camera(c)
    _check_mirror(c)
    _check_stages(c)


def _check_minibatches(c: Config) -> None:
    robots, parts = c.run.num_envs, c.ppo.minibatches
    if robots % parts:
        below, above = robots // parts * parts, -(-robots // parts) * parts
        near = f"{below} or {above}" if below else f"{above}"
        raise ConfigError(f"{robots} robots do not split into {parts} minibatches; take {near}")


def _check_times(c: Config) -> None:
    """Refuse control steps that no motor follows, and actions that come after the next one."""
    period = c.physics.control_period
    if not CONTROL.allows(period):
        raise ConfigError(
            f"--physics.timestep times --physics.substeps must be {CONTROL} s, not {period:g}"
        )
    if c.randomisation.action_delay > period + 1e-9:
        raise ConfigError(
            f"--randomisation.action-delay must be at most a control step, {period:g} s, not "
            f"{c.randomisation.action_delay}"
        )


def _check_learning_rate(c: Config) -> None:
    """Refuse a rate that the first update would change to another one."""
    low, high = c.ppo.learning_rate_range
    if not low <= c.ppo.learning_rate <= high:
        raise ConfigError(
            f"--ppo.learning-rate must be within --ppo.learning-rate-range, {low:g} to {high:g}, "
            f"not {c.ppo.learning_rate:g}"
        )


def _check_shares(c: Config) -> None:
    """Refuse shares of robots that are more than all."""
    alone = c.randomisation.undisturbed, c.randomisation.pushed_alone
    if sum(alone) > 1.0:
        raise ConfigError(
            f"--randomisation.undisturbed and --randomisation.pushed-alone must be 1 together at "
            f"most, not {alone[0]:g} and {alone[1]:g}"
        )


def _check_footholds(c: Config) -> None:
    """Refuse windows that no foothold can be found in."""
    points, window = c.foothold.points, c.foothold.window
    if window[0] > points[0] or window[1] != points[1]:
        raise ConfigError(
            f"--foothold.window, {window[0]} {window[1]}, must be at most as long and exactly as "
            f"wide as --foothold.points, {points[0]} {points[1]}"
        )
    if c.foothold.min_points > math.prod(window):
        raise ConfigError(
            f"--foothold.min-points must be at most the {math.prod(window)} of --foothold.window, "
            f"not {c.foothold.min_points}"
        )


def _check_camera(c: Config) -> None:
    """Refuse images that the depth tokenizer's filters do not cover exactly."""
    if c.camera.window % 2 == 0:
        raise ConfigError(f"--camera.window must be 1, 3, 5, ..., not {c.camera.window}")
    if not c.network.sees:
        return
    if c.network.token % c.network.heads:
        heads = f"{c.network.heads} heads"
        raise ConfigError(f"--network.token, {c.network.token}, does not split into {heads}")
    if not c.network.convolutions:
        raise ConfigError("--network.convolutions must have a layer")
    shrink = math.prod(stride for _, _, stride in c.network.convolutions)
    blocks = math.lcm(shrink, COMPRESSION)
    for size, what in zip(c.camera.shape, ("rows", "columns"), strict=True):
        if size < blocks or size % blocks:
            near = max(round(size / blocks), 1) * blocks
            raise ConfigError(
                f"--camera.shape: {size} {what} do not split into blocks of {blocks} x {blocks} "
                f"pixels; take {near}"
            )
        for _, kernel, pool in c.network.convolutions if c.network.variant == "hpl" else ():
            size = (size - kernel + 1) // pool
            if size < 1:
                raise ConfigError(f"--network.convolutions leave no pixel of the {what}")


def _check_mirror(c: Config) -> None:
    """Refuse a symmetry loss of an actor whose inputs have no mirror here."""
    if c.ppo.mirror_weight and c.network.variant in HPL:
        raise ConfigError(
            f"--ppo.mirror-weight must be 0 with --network.variant {c.network.variant}"
        )


def _check_stages(c: Config) -> None:
    """Refuse a run that leaves no iteration to the student."""
    first, last = c.distillation.teacher_iterations or 1, c.run.iterations
    if c.network.variant == "hpl" and first >= last:
        raise ConfigError(
            f"--distillation.teacher-iterations must be below --run.iterations, {last}, not {first}"
        )
