"""Every number of the program, with its unit and its source.

A comment that names a table, a section or an equation points into the CReF paper; `assumed:` marks
what the paper does not say, so that `grep -rn "assumed:" cref_jax` is the complete list of choices.
Defaults are the paper's. A run changes them by a TOML file of differences or on the command line.
"""

from dataclasses import dataclass, field
from typing import Literal

Variant = Literal["full", "no_cross_attention", "no_grf", "no_highway", "blind"]


@dataclass(frozen=True)
class Robot:
    """The robot, and how the policy drives it (Sec. III-A)."""

    name: str = "x2_ultra"  # an entry of robot/registry.py
    actuated: Literal["legs", "legs+waist", "all"] = "legs"  # assumed: Table I regularises these
    held: Literal["none", "waist", "all"] = "all"  # moves, too, held by its motors; the rest is
    # welded. assumed: welded, transfer to the whole robot suffers, see experiments/RESULTS.md
    action_scale: float = 0.25  # of effort / kp, rad; assumed: the usual scale for these gains
    action_clip: float = 10.0  # actions; assumed: far outside what is ever useful


@dataclass(frozen=True)
class Physics:
    """The simulation step, the same in every engine."""

    timestep: float = 0.005  # s; assumed: four substeps a control step are stable
    substeps: int = 4  # 4 x 5 ms = 20 ms = 50 Hz, Sec. II-D
    iterations: int = 6  # Newton; assumed: with 4, MJX and MuJoCo C part by up to 0.03 rad/s a step
    line_search: int = 10  # assumed: as for the iterations
    velocity_limit: float = 100.0  # m/s or rad/s; assumed: beyond it a state has blown up

    @property
    def control_period(self) -> float:
        """Length of a control step, s."""
        return self.timestep * self.substeps


@dataclass(frozen=True)
class RewardWeights:
    """Weights w_i of Table I. A field here is a function of the same name in env/rewards.py."""

    linear_velocity_tracking: float = 2.5
    angular_velocity_tracking: float = 1.5
    orientation: float = 1.0
    feet_contact: float = 1.5
    feet_y_distance: float = 0.1
    foothold_placement: float = 2.0
    foothold_missed: float = 0.0  # not in Table I
    foot_contact_quality: float = 0.0  # BeamDojo's term, in place of foothold_placement
    base_height: float = 0.8
    linear_velocity_z: float = -1.0
    angular_velocity_xy: float = -0.05
    joint_velocity: float = -1e-3
    action_rate: float = -0.01
    action_smoothness: float = -0.01
    feet_air_time: float = -2.5
    air_time_variance: float = 0.0  # not in Table I
    foot_up_when_standing: float = 0.0  # not in Table I
    foot_slip: float = -0.2
    foot_impact_acceleration: float = -0.5
    foot_impact_velocity: float = -1.5
    joint_position_limits: float = -10.0
    joint_velocity_limits: float = -0.6
    hip_position: float = -7.0
    ankle_position: float = -10.0
    stumble: float = -10.0


@dataclass(frozen=True)
class Reward:
    """Constants inside the reward expressions of Table I."""

    weights: RewardWeights = field(default_factory=RewardWeights)
    times_dt: bool = True  # assumed: legged_gym's convention
    event_time: float = 0.25  # s that a touchdown counts for then; assumed: one control step, as
    # legged_gym has it, is too little for air time and footholds to lengthen a step
    clip_at_zero: bool = True  # of all terms but touchdowns; assumed: without it the negative sum
    # at first teaches falling
    clip_touchdowns: bool = False  # touchdowns within that cut: few samples then lift feet sooner
    debounce: int = 2  # control steps with contact, or without, until a foot counts as down or up;
    # assumed: a scuff of one step is neither. 1: each contact is a touchdown
    sigma_v: float = 0.25  # m^2/s^2; assumed: legged_gym
    sigma_omega: float = 0.25  # rad^2/s^2; assumed: legged_gym
    low_speed: float = 0.2  # m/s, v_s; assumed: between 0.1 and 0.2 in published code
    standing: float = 0.1  # u_s; assumed: between 0.05 and 0.1 in published code
    single_contact_window: float = 0.2  # s, Table I
    feet_y_target: float = 0.27  # m, Table I
    foothold_tolerance: float = 0.08  # m, s_xz; assumed: the one published reimplementation
    base_height_target: float = 0.55  # m above the ankle-roll frames, Table I
    support_force: float = 1.0  # N, Eq. 5
    contact_force: float = 5.0  # N, Table I (foot slip)
    air_time_target: float = 0.5  # s, Table I
    impact_acceleration: float = 50.0  # m/s^2, a_0; assumed: no source states one
    impact_velocity: float = 0.6  # m/s, v_0; assumed: no source states one
    stumble_ratio: float = 5.0  # Table I
    soft_limit: float = 0.95  # of the joint range; assumed: as in legged_gym, 0.9 to 0.95


@dataclass(frozen=True)
class Command:
    """What the robot is asked to do. Ranges are uniform."""

    vx: tuple[float, float] = (0.0, 1.0)  # m/s; assumed: covers the 0.4-0.8 of Sec. III-A
    vy: tuple[float, float] = (-0.3, 0.3)  # m/s; assumed
    yaw_rate: tuple[float, float] = (-1.0, 1.0)  # rad/s; assumed
    standing: float = 0.1  # share of standing commands; assumed
    zero: float = 0.0  # chance of each part of a command in the open to be 0: to turn on the spot
    lane_free: float = 0.1  # share of the commands on a lane that are as in the open; assumed
    period: tuple[float, float] = (8.0, 12.0)  # s between two draws; assumed
    open_kinds: tuple[str, ...] = ("flat",)  # walked in all directions; the rest along a lane
    lane_vx: tuple[float, float] = (0.4, 0.8)  # m/s on terrain, Sec. III-A
    heading_gain: float = 2.0  # 1/s, yaw rate per radian off the lane's direction; assumed
    lane_gain: float = 1.5  # rad/m, heading per metre off the lane's middle; assumed: with 0.5
    # robots drifted into hand-rails
    lane_yaw_rate: float = 0.6  # rad/s, limit of the heading control; assumed


@dataclass(frozen=True)
class Randomisation:
    """Domain randomisation, drawn anew at each reset. assumed: the paper names none."""

    enabled: bool = True
    friction: tuple[float, float] = (0.3, 1.2)  # sliding friction coefficient
    trunk_mass: float = 2.5  # kg, +-
    trunk_com: float = 0.05  # m, +-, each axis
    gains: tuple[float, float] = (0.8, 1.2)  # factor on kp and, apart, on kd
    joint_offset: float = 0.035  # rad, +-, encoder zero
    action_delay: float = 0.020  # s, up to
    push_velocity: float = 1.0  # m/s, up to, planar
    push_period: tuple[float, float] = (5.0, 10.0)  # s between two pushes
    noise_angular_velocity: float = 0.2  # rad/s, +-
    noise_gravity: float = 0.05  # +-
    noise_joint_position: float = 0.01  # rad, +-
    noise_joint_velocity: float = 1.5  # rad/s, +-
    camera_pitch: float = 2.0  # deg, +-, how the camera is mounted
    camera_position: float = 0.01  # m, +-, each axis
    ramp: bool = False  # begin with none of it, and let it grow with competence
    ramp_falls: tuple[float, float] = (2.5, 4.0)  # per minute: fewer raise, more lower; assumed
    ramp_step: float = 0.005  # of all ranges, per iteration; assumed


@dataclass(frozen=True)
class Episode:
    """How an episode starts and ends."""

    length: float = 20.0  # s; assumed: 20 s in training, 40 s in evaluation
    max_tilt: float = 1.0  # rad; assumed
    min_height: float = 0.15  # m, pelvis above the supporting ankles, 0.22 above the sole; assumed:
    # a foot comes down on a box of 40 cm when the pelvis is still 0.3 m above the box
    below_edge: float = 0.5  # m, a foot below the last support: into a gap; assumed: two 23 cm
    # treads at once are still a step, and gap floors lie 1 m down
    stall_time: float = 5.0  # s between two looks whether a robot stands in its lane, 0: none;
    # assumed: half of what a trial gives it. Nothing is learned from standing before an obstacle
    start_x: tuple[float, float] = (0.5, 1.0)  # m along the lane; assumed
    start_anywhere: float = 0.0  # share of the episodes that begin on any level stretch of the lane
    # before its last obstacle; assumed
    start_y: tuple[float, float] = (-0.3, 0.3)  # m across the lane; assumed
    lane_end: float = 1.0  # m before the lane's end where an episode is won; assumed
    yaw_jitter: float = 0.2  # rad, +-, at reset on a lane; assumed
    bank_size: int = 64  # settled states to start from; assumed
    settle_time: float = 0.4  # s under PD before a state enters the bank; assumed: the feet have
    # settled, and PD alone, which holds the pose for 1.5 s, has not begun to fall


@dataclass(frozen=True)
class Terrain:
    """The lanes that robots are trained on. Sizes of obstacles stand in terrains/*.toml."""

    name: str = "flat"  # a file in terrains/, or a path to .toml, .npy or .png
    cell: float = 0.02  # m; assumed: divides treads, windows and strides
    lane_length: float = 12.0  # m; assumed
    lane_width: float = 4.0  # m; assumed
    levels: int = 10  # assumed: as legged_gym
    variants: int = 1  # lanes of each level and kind, one of which is drawn at each reset; assumed
    seed: int = 1  # of the random heights and landings


@dataclass(frozen=True)
class Curriculum:
    """Which level of its terrain a robot meets next. assumed: legged_gym's rule."""

    enabled: bool = True
    up: float = 0.5  # of the lane walked: one level harder
    down: float = 0.5  # less than this share of what the episode asked for: one level easier
    start_level: int = 2  # highest level at the start
    review: float = 0.25  # share of episodes on a lower level, so that none is forgotten


@dataclass(frozen=True)
class Scan:
    """The critic's height samples m_t, in the robot's yaw frame (Eq. 3)."""

    x: tuple[float, float, int] = (-0.5, 1.1, 17)  # m from, m to, samples; assumed
    y: tuple[float, float, int] = (-0.4, 0.4, 9)  # m from, m to, samples; assumed
    ahead: tuple[float, float, int] = (-0.2, 1.0, 25)  # m from, m to, samples of a finer row along
    # x in the middle; assumed: 10 cm cannot say where an edge is
    base_height: float = 0.62  # m, nominal, taken off; the base above the soles at q_0
    clip: float = 1.0  # m; assumed


@dataclass(frozen=True)
class Camera:
    """The depth camera, a RealSense D435i looking down at the ground ahead (Sec. III-A)."""

    shape: tuple[int, int] = (48, 64)  # rows, columns, Sec. II-D
    view: tuple[float, float] = (58.0, 87.0)  # deg, vertical, horizontal; D435i data sheet, for
    # streams of 16:9; assumed: one of them, squeezed, since those of 4:3 show less, 62 x 75
    d_max: float = 3.0  # m, Sec. II-B; assumed: published work clips at 2 to 3 m
    pitch: float = 50.0  # deg below the horizontal, Sec. III-A
    rate: float = 20.0  # 1/s, Sec. II-D
    window: int = 1  # pixels, odd: each is the nearest of a square of so many, as a stereo camera
    # matches squares and sees no hole smaller than one; 1, the paper's: a ray per pixel


@dataclass(frozen=True)
class Foothold:
    """The foothold placement reward (Sec. II-C), and the contact quality it is compared with."""

    points: tuple[int, int] = (60, 5)  # samples forward, across, Sec. II-C
    spacing: tuple[float, float] = (0.02, 0.025)  # m; assumed: window and stride are whole numbers
    window: tuple[int, int] = (12, 5)  # samples: 24 cm x 10 cm, Sec. II-C
    stride: int = 2  # samples: 4 cm, Sec. II-C
    gate_time: float = 0.5  # s of commanded travel, Sec. II-C
    gate: Literal["points", "windows"] = "points"  # what is removed for being nearer than that: the
    # points, so that a window is of those that remain (Sec. II-C), or each window with such a point
    min_points: int = 10  # of a window of remaining points; assumed: two rows of five
    roughness: float = 0.010  # m, r_th; assumed: refuses windows with an edge of 5 cm in them
    verticality: float = 0.9  # eta_th; assumed: slopes up to 0.4 pass, windows over a riser do not
    min_height: float = -0.5  # m, h_min; assumed: two 23 cm treads down pass, a gap's floor not
    quality_x: tuple[float, float, int] = (-0.06, 0.13, 5)  # m from, m to, samples of the sole
    quality_y: tuple[float, float, int] = (-0.05, 0.05, 3)  # m from, m to, samples of the sole
    quality_depth: float = -0.03  # m under the sole, epsilon of the contact quality; assumed:
    # BeamDojo's -0.1 is an absolute height, and stairs have no level to measure it from


@dataclass(frozen=True)
class Network:
    """Widths of the actor (Sec. II-B) and of the critic. assumed: the paper gives none."""

    variant: Variant = "full"
    convolutions: tuple[tuple[int, int, int], ...] = ((32, 4, 4), (64, 3, 2))
    # of the depth tokenizer: channels, kernel, stride; 48 x 64 pixels to 6 x 8 tokens, in a third
    # less time an update than three 3 x 3 filters of stride 2 on a CPU
    token: int = 128  # d
    heads: int = 4  # of the cross attention
    compressed: int = 32  # C_psi(D)
    lstm: int = 256  # velocity estimator
    gru: int = 256  # recurrent fusion
    actor: tuple[int, ...] = (512, 256, 128)  # action head
    critic: tuple[int, ...] = (512, 256, 128)
    critic_sees: Literal["paper", "all"] = "all"  # Eq. 3 alone, or with all that the reward depends
    # on and all that is drawn per robot; assumed
    initial_std: float = 0.8  # of the action distribution
    min_std: float = 0.0  # of it, while training: late obstacles are found by exploring, too


@dataclass(frozen=True)
class PPO:
    """Proximal policy optimisation. assumed: mjlab's numbers for a humanoid of this size."""

    horizon: int = 24  # control steps an iteration
    epochs: int = 5
    minibatches: int = 4
    clip: float = 0.2
    value_clip: float = 0.2
    value_weight: float = 1.0
    entropy_weight: float = 0.005
    estimator_weight: float = 1.0  # of the velocity estimator's L2 loss
    readout_weight: float = 0.0  # of the loss of telling m_t by the actor's features; the paper: 0
    mirror_weight: float = 0.0  # of the loss of acting otherwise in the mirror; the paper: 0
    gamma: float = 0.99
    lam: float = 0.95
    learning_rate: float = 1e-3
    learning_rate_range: tuple[float, float] = (1e-5, 1e-2)
    target_kl: float = 0.01
    max_gradient_norm: float = 1.0
    average: int = (
        200  # iterations, at most, over which the policy that is kept is averaged; assumed
    )
    critic_first: int = 0  # iterations in which the critic alone learns; for a run with --init


@dataclass(frozen=True)
class Run:
    """How large a run is, and how often it is written down."""

    num_envs: int = 4096  # robots at once, Sec. II-D
    iterations: int = 20_000  # Sec. II-D
    seed: int = 0
    chunk: int = 10  # iterations in one call of the compiled program; changes no result
    checkpoint_minutes: float = 5.0  # between two checkpoints
    keep: int = 3  # checkpoints that stay on disk


@dataclass(frozen=True)
class Config:
    """One run, whole."""

    run: Run = field(default_factory=Run)
    robot: Robot = field(default_factory=Robot)
    physics: Physics = field(default_factory=Physics)
    terrain: Terrain = field(default_factory=Terrain)
    curriculum: Curriculum = field(default_factory=Curriculum)
    command: Command = field(default_factory=Command)
    episode: Episode = field(default_factory=Episode)
    randomisation: Randomisation = field(default_factory=Randomisation)
    reward: Reward = field(default_factory=Reward)
    scan: Scan = field(default_factory=Scan)
    camera: Camera = field(default_factory=Camera)
    foothold: Foothold = field(default_factory=Foothold)
    network: Network = field(default_factory=Network)
    ppo: PPO = field(default_factory=PPO)
