"""Settings of the task: rewards, commands, randomisation, episodes, curriculum."""

from dataclasses import dataclass, field


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
    wall_contact: float = 0.0  # per contact sphere at a wall; not in Table I


@dataclass(frozen=True)
class Reward:
    """Constants inside the reward expressions of Table I."""

    weights: RewardWeights = field(default_factory=RewardWeights)
    times_dt: bool = True  # assumed: legged_gym's convention
    event_time: float = 0.25
    """s that a touchdown counts for with times_dt. assumed: one control step, as in legged_gym, is
    too little for air time and footholds to lengthen a step"""
    clip_at_zero: bool = True
    """Cut the sum of all terms but touchdowns at 0 from below. assumed: without it the sum,
    negative at first, teaches falling"""
    clip_touchdowns: bool = False
    """Include touchdowns in that cut: with few samples, feet are lifted sooner"""
    debounce: int = 2
    """Control steps with contact, or without, until a foot counts as down, or up. 1: each contact
    is a touchdown. assumed: a scuff of one step is neither"""
    sigma_v: float = 0.25  # m^2/s^2; assumed: legged_gym
    sigma_omega: float = 0.25  # rad^2/s^2; assumed: legged_gym
    low_speed: float = 0.2  # m/s, v_s; assumed: between 0.1 and 0.2 in published code
    standing: float = 0.1  # u_s; assumed: between 0.05 and 0.1 in published code
    single_contact_window: float = 0.2  # s, Table I
    feet_y_target: float | None = None  # m, Table I; None: the robot's
    foothold_tolerance: float = 0.08  # m, s_xz; assumed: the one published reimplementation
    base_height_target: float | None = None  # m above the ankles, Table I; None: the robot's
    support_force: float = 1.0  # N, Eq. 5
    contact_force: float = 5.0  # N, Table I (foot slip)
    air_time_target: float = 0.5  # s, Table I
    impact_acceleration: float = 50.0  # m/s^2, a_0; assumed: no source states one
    impact_velocity: float = 0.6  # m/s, v_0; assumed: no source states one
    stumble_ratio: float = 5.0  # Table I
    soft_limit: float = 0.95  # of the joint range; assumed: as in legged_gym, 0.9 to 0.95


@dataclass(frozen=True)
class Command:
    """Velocity commands. Ranges are uniform."""

    vx: tuple[float, float] = (0.0, 1.0)  # m/s; assumed: covers the 0.4-0.8 of Sec. III-A
    vy: tuple[float, float] = (-0.3, 0.3)  # m/s; assumed
    yaw_rate: tuple[float, float] = (-1.0, 1.0)  # rad/s; assumed
    standing: float = 0.1  # share of standing commands; assumed
    zero: float = 0.0  # chance that a part of a command in the open is 0: turning on the spot
    lane_free: float = 0.1  # share of commands on a lane drawn as in the open; assumed
    period: tuple[float, float] = (8.0, 12.0)  # s between two draws; assumed
    open_kinds: tuple[str, ...] = ("flat",)  # walked in all directions; the rest along a lane
    lane_vx: tuple[float, float] = (0.4, 0.8)  # m/s on terrain, Sec. III-A
    heading_gain: float = 2.0  # 1/s, yaw rate per radian off the lane's direction; assumed
    lane_gain: float = 1.5  # rad/m off the lane's middle; assumed: with 0.5 robots hit hand-rails
    lane_yaw_rate: float = 0.6  # rad/s, limit of the heading control; assumed


@dataclass(frozen=True)
class Randomisation:
    """Domain randomisation, drawn anew at each reset. assumed: the paper names none."""

    enabled: bool = True
    friction: tuple[float, float] = (0.3, 1.2)  # sliding friction coefficient
    trunk_mass: float = 2.5  # kg, +-
    trunk_com: float = 0.05  # m, +-, each axis
    gains: tuple[float, float] = (0.8, 1.2)  # factor on kp, another on kd
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
    structures: int = 0
    """Capsules per episode in the depth image alone: rails, walls, posts and bars beside and over
    the lane"""
    perforations: float = 0.0
    """m, the widest holes that the depth image shows in the ground of half of the episodes, on
    lanes of terrain.slit_kinds, whatever else is randomised; steps may have no risers, too"""
    depth_noise: float = 0.0
    """m, deviation of depth at 1 m, up to; grows with depth squared, as in stereo"""
    depth_scale: float = 0.0  # +-, share by which all depths are wrong
    depth_dead: float = 0.0  # share of dead columns, up to
    depth_holes: float = 0.0  # share of the image without a reading, up to
    narrow_view: float = 0.0  # chance of a camera that shows 75 x 62 deg, as at 640 x 480
    push_yaw_rate: float = 0.0  # rad/s, up to, with each push, as of a wrist that meets a rail
    undisturbed: float = 0.0  # share of robots for which nothing is randomised, in training
    pushed_alone: float = 0.0  # share of robots that are pushed, with nothing else randomised
    ramp: bool = False  # begin with none of it, and let it grow with competence
    ramp_falls: tuple[float, float] = (2.5, 4.0)  # per minute: fewer raise, more lower; assumed
    ramp_step: float = 0.005  # of all ranges, per iteration; assumed


@dataclass(frozen=True)
class Episode:
    """How an episode starts and ends."""

    length: float = 20.0  # s; assumed: 20 s in training, 40 s in evaluation
    max_tilt: float = 1.0  # rad; assumed
    min_height: float | None = None  # m, base above the supporting ankles; None: the robot's
    below_edge: float = 0.5
    """m, a foot below the last support: it is in a gap. assumed: two 23 cm treads at once are still
    a step, and gap floors lie 1 m down"""
    stall_time: float = 5.0
    """s between stall checks; 0 disables them. assumed: half of what a trial allows. Nothing is
    learned from standing before an obstacle"""
    start_x: tuple[float, float] = (0.5, 1.0)  # m along the lane; assumed
    start_anywhere: float = 0.0
    """Share of episodes that begin on any level stretch before the lane's last obstacle; assumed"""
    start_y: tuple[float, float] = (-0.3, 0.3)  # m across the lane; assumed
    lane_end: float = 1.0  # m before the lane's end where an episode is won; assumed
    yaw_jitter: float = 0.2  # rad, +-, at reset on a lane; assumed
    bank_size: int = 64  # settled states to start from; assumed
    settle_time: float = 0.4
    """s under PD before a state enters the bank. assumed: the feet have settled, and PD alone,
    which holds the pose for 1.5 s, has not begun to fall"""


@dataclass(frozen=True)
class Curriculum:
    """The level of the next episode. assumed: legged_gym's rule."""

    enabled: bool = True
    up: float = 0.5  # of the lane walked: one level harder
    down: float = 0.5  # less than this share of what the episode asked for: one level easier
    start_level: int = 2  # highest level at the start
    review: float = 0.25  # share of episodes on a lower level, so that none is forgotten
