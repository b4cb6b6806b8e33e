"""Table I: a number worked by hand for each row, the weights, and how they are summed."""

import dataclasses
import inspect
import math

import jax.numpy as jnp
import numpy as np
import pytest

from cref_jax import config, robot
from cref_jax.env import rewards

C = robot.fill_in(config.Config()).reward
PERIOD = 0.02  # s
TABLE_1 = {
    "linear_velocity_tracking": 2.5,
    "angular_velocity_tracking": 1.5,
    "orientation": 1.0,
    "feet_contact": 1.5,
    "feet_y_distance": 0.1,
    "foothold_placement": 2.0,
    "base_height": 0.8,
    "linear_velocity_z": -1.0,
    "angular_velocity_xy": -0.05,
    "joint_velocity": -1e-3,
    "action_rate": -0.01,
    "action_smoothness": -0.01,
    "feet_air_time": -2.5,
    "foot_slip": -0.2,
    "foot_impact_acceleration": -0.5,
    "foot_impact_velocity": -1.5,
    "joint_position_limits": -10.0,
    "joint_velocity_limits": -0.6,
    "hip_position": -7.0,
    "ankle_position": -10.0,
    "stumble": -10.0,
}


@pytest.fixture(scope="module")
def x2() -> robot.Robot:
    return robot.load(config.Robot())


def perfect(x2: robot.Robot) -> rewards.Snapshot:
    """Stand as Table I wants it: every reward is 1 and every penalty 0."""
    still = jnp.zeros(3)
    joints = jnp.zeros(x2.num_joints)
    return rewards.Snapshot(
        velocity=still,
        angular_velocity=still,
        gravity=jnp.array([0.0, 0.0, -1.0]),
        command=still,
        base_z=jnp.float32(0.55),
        joint_position=jnp.asarray(x2.nominal_pose),
        joint_velocity=joints,
        action=joints,
        action_1=joints,
        action_2=joints,
        foot_z=jnp.zeros(2),
        feet_y=jnp.float32(0.27),
        foot_velocity=jnp.zeros((2, 3)),
        foot_velocity_before=jnp.zeros((2, 3)),
        foot_force=jnp.array([[0.0, 0.0, 200.0], [0.0, 0.0, 200.0]]),
        first_contact=jnp.zeros(2, bool),
        air_time=jnp.full(2, PERIOD),
        last_air_time=jnp.zeros(2),
        foothold_distance=jnp.full(2, jnp.inf),
        unsupported=jnp.zeros(2, jnp.int32),
        walls_touched=jnp.int32(0),
        since_single=jnp.float32(9.0),
        control_period=jnp.float32(PERIOD),
    )


def walking(x2: robot.Robot) -> rewards.Snapshot:
    """Walk at 0.6 m/s as Table I wants it."""
    ahead = jnp.array([0.6, 0.0, 0.0])
    return perfect(x2)._replace(velocity=ahead, command=ahead, since_single=jnp.float32(0.0))


def joints(x2: robot.Robot, start, **changes) -> list[float]:
    """Return `start`, one number a joint, with the named joints set, rad or rad/s."""
    values = np.array(np.broadcast_to(start, x2.num_joints), np.float64)
    for name, value in changes.items():
        values[x2.joint_names.index(f"{name}_joint")] = value
    return list(values)


def padded(x2: robot.Robot, *values: float) -> list[float]:
    return [*values, *[0.0] * (x2.num_joints - len(values))]


def check(x2: robot.Robot, name: str, expected: float, **changes) -> None:
    like = perfect(x2)
    snapshot = like._replace(
        **{k: jnp.asarray(v, getattr(like, k).dtype) for k, v in changes.items()}
    )
    found = rewards.TERMS[name](snapshot, C, x2)
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-6)


def test_every_function_of_a_snapshot_alone_is_a_term_with_a_weight():
    takes = lambda f: list(inspect.signature(f).parameters) == ["s", "c", "robot"]
    functions = {n for n, f in vars(rewards).items() if inspect.isfunction(f) and takes(f)}
    assert set(rewards.TERMS) == functions - {"total"}
    assert list(rewards.TERMS) == [f.name for f in dataclasses.fields(config.RewardWeights)]


def test_the_weights_are_those_of_table_1_and_what_it_has_not_is_off():
    weights = dataclasses.asdict(config.RewardWeights())
    assert weights == dict.fromkeys(rewards.TERMS, 0.0) | TABLE_1


def test_foothold_placement(x2):
    # the left foot comes down 8 cm from its candidate: exp(-0.08 / 0.08); the right is in the air
    touchdown = {"first_contact": [True, False], "foothold_distance": [0.08, 0.0]}
    check(x2, "foothold_placement", math.exp(-1.0), **touchdown)
    check(x2, "foothold_placement", 2.0, first_contact=[True, True], foothold_distance=[0.0, 0.0])
    # no candidate: nothing, and a number
    check(x2, "foothold_placement", 0.0, first_contact=[True, True])


def test_foothold_missed(x2):
    # 8 cm beside: 1 - exp(-1); on the candidate, or where there is none: nothing
    feet = {"first_contact": [True, True]}
    check(x2, "foothold_missed", 1.0 - math.exp(-1.0), foothold_distance=[0.08, 0.0], **feet)
    check(x2, "foothold_missed", 0.0, **feet)
    check(x2, "foothold_missed", 0.0, first_contact=[False, True], foothold_distance=[0.08, 0.0])


def test_footholds_can_weigh_more_without_paying_for_more_steps(x2):
    # with weights 2 and -4 a perfect step is worth 2, and 8 cm beside costs three times as much
    weigh = lambda d, placed, missed: float(
        placed * rewards.foothold_placement(stepped(x2, d), C, x2)
        + missed * rewards.foothold_missed(stepped(x2, d), C, x2)
    )
    assert weigh(0.0, 2.0, -4.0) == weigh(0.0, 2.0, 0.0) == 2.0
    cost = lambda missed: weigh(0.0, 2.0, missed) - weigh(0.08, 2.0, missed)
    assert cost(-4.0) == pytest.approx(3.0 * cost(0.0))


def stepped(x2: robot.Robot, distance: float) -> rewards.Snapshot:
    """Put one foot down so far from its nearest candidate."""
    down = jnp.array([True, False])
    return walking(x2)._replace(first_contact=down, foothold_distance=jnp.full(2, distance))


def test_foot_contact_quality(x2):
    # left: 6 samples over nothing, in contact; right: 15, in the air
    forces = [[0.0, 0.0, 300.0], [0.0, 0.0, 0.0]]
    check(x2, "foot_contact_quality", 6.0, unsupported=[6, 15], foot_force=forces)


def test_linear_velocity_tracking(x2):
    # e = (0.5, 0.1) - (0.3, -0.1) = (0.2, 0.2); |u| = 0.51 is fast: (0.04 + 0.04) / 0.25 = 0.32
    check(
        x2,
        "linear_velocity_tracking",
        math.exp(-0.32),
        command=[0.5, 0.1, 0.7],
        velocity=[0.3, -0.1, 9.0],
    )
    # e = (0.1, 0) - (-0.1, 0.1) = (0.2, -0.1); |u| = 0.1 is slow: (0.2 + 0.1) / 0.25 = 1.2
    check(
        x2,
        "linear_velocity_tracking",
        math.exp(-1.2),
        command=[0.1, 0.0, 0.7],
        velocity=[-0.1, 0.1, 9.0],
    )


def test_angular_velocity_tracking(x2):
    # (0.3 - 0.8)^2 / 0.25 = 1
    check(
        x2,
        "angular_velocity_tracking",
        math.exp(-1.0),
        angular_velocity=[5.0, 5.0, 0.3],
        command=[0.0, 0.0, 0.8],
    )


def test_orientation(x2):
    # 10 |(0.03, -0.04)| = 10 * 0.05 = 0.5
    check(x2, "orientation", math.exp(-0.5), gravity=[0.03, -0.04, -0.99])


def test_feet_contact(x2):
    # |(0.05, 0, 0.05)| = 0.07 < 0.1: standing is always rewarded
    check(x2, "feet_contact", 1.0, command=[0.05, 0.0, 0.05], since_single=9.0)
    # turning alone is not standing; one foot alone has touched 0.20 s ago, 0.22 s ago
    check(x2, "feet_contact", 1.0, command=[0.0, 0.0, 0.2], since_single=0.2)
    check(x2, "feet_contact", 0.0, command=[0.0, 0.0, 0.2], since_single=0.22)


def test_feet_y_distance(x2):
    # 10 |0.37 - 0.27| = 1
    check(x2, "feet_y_distance", math.exp(-1.0), feet_y=0.37)


def test_base_height(x2):
    both = [[0.0, 0.0, 50.0], [0.0, 0.0, 20.0]]
    left = [[0.0, 0.0, 50.0], [0.0, 0.0, 1.0]]  # 1 N does not support: the test is F > 1
    # both feet: z_supp = (0.1 + 0.3) / 2 = 0.2; 10 |0.85 - 0.2 - 0.55| = 1
    check(x2, "base_height", math.exp(-1.0), base_z=0.85, foot_z=[0.1, 0.3], foot_force=both)
    # the left one: z_supp = 0.1; 0.65 - 0.1 = 0.55
    check(x2, "base_height", 1.0, base_z=0.65, foot_z=[0.1, 0.3], foot_force=left)
    # none: the lower foot, z_supp = 0.1; 10 |0.55 - 0.1 - 0.55| = 1
    check(
        x2,
        "base_height",
        math.exp(-1.0),
        base_z=0.55,
        foot_z=[0.3, 0.1],
        foot_force=np.zeros((2, 3)),
    )


def test_linear_velocity_z(x2):
    # 0.5^2 = 0.25
    check(x2, "linear_velocity_z", 0.25, velocity=[9.0, 9.0, -0.5])


def test_angular_velocity_xy(x2):
    # 3^2 + 4^2 = 25
    check(x2, "angular_velocity_xy", 25.0, angular_velocity=[3.0, -4.0, 9.0])


def test_joint_velocity(x2):
    # 1 + 4 + 4 = 9
    check(x2, "joint_velocity", 9.0, joint_velocity=padded(x2, 1.0, 2.0, -2.0))


def test_action_rate(x2):
    # (1 - -1)^2 + (0 - 0.5)^2 = 4.25
    check(x2, "action_rate", 4.25, action=padded(x2, 1.0, 0.0), action_1=padded(x2, -1.0, 0.5))


def test_action_smoothness(x2):
    # (1 - 2*2 - 1)^2 + (0 - 2*0.5 + 0)^2 = 16 + 1
    check(
        x2,
        "action_smoothness",
        17.0,
        action=padded(x2, 1.0, 0.0),
        action_1=padded(x2, 2.0, 0.5),
        action_2=padded(x2, -1.0, 0.0),
    )


def test_feet_air_time(x2):
    # (0.5 - 0.3) + (0.5 - 0.9) = -0.2; the left foot alone: 0.2; no foot: 0
    check(x2, "feet_air_time", -0.2, first_contact=[True, True], air_time=[0.3, 0.9])
    check(x2, "feet_air_time", 0.2, first_contact=[True, False], air_time=[0.3, 0.9])
    check(x2, "feet_air_time", 0.0, air_time=[0.3, 0.9])


def test_air_time_variance(x2):
    # the last swings took 0.46 and 0.20 s: (0.13)^2
    limp = {"first_contact": [False, True], "last_air_time": [0.46, 0.20]}
    check(x2, "air_time_variance", 0.0169, **limp)
    check(x2, "air_time_variance", 0.0, last_air_time=[0.46, 0.20])  # no foot comes down
    check(x2, "air_time_variance", 0.0, first_contact=[True, False], last_air_time=[0.3, 0.0])
    check(x2, "air_time_variance", 0.0, first_contact=[True, False], last_air_time=[0.3, 0.3])


def test_foot_up_when_standing(x2):
    up = [[0.0, 0.0, 200.0], [0.0, 0.0, 5.0]]  # N
    check(x2, "foot_up_when_standing", 1.0, foot_force=up)
    check(x2, "foot_up_when_standing", 2.0, foot_force=np.zeros((2, 3)))
    check(x2, "foot_up_when_standing", 0.0, foot_force=up, command=[0.2, 0.0, 0.0])


def test_foot_slip(x2):
    # |(0, 3, 4)| = 5 is not above 5; |(0, 0, 6)| is: |(0.1, 0.2, 0.2)| = 0.3
    check(
        x2,
        "foot_slip",
        0.3,
        foot_force=[[0.0, 3.0, 4.0], [0.0, 0.0, 6.0]],
        foot_velocity=[[7.0, 7.0, 7.0], [0.1, 0.2, 0.2]],
    )


def test_foot_impact_acceleration(x2):
    # |0 - -1.5| / 0.02 - 50 = 25; |0.5 - 0| / 0.02 = 25 is below 50
    check(
        x2,
        "foot_impact_acceleration",
        25.0,
        foot_velocity=[[9.0, 9.0, 0.0], [0.0, 0.0, 0.5]],
        foot_velocity_before=[[0.0, 0.0, -1.5], [0.0, 0.0, 0.0]],
    )


def test_foot_impact_velocity(x2):
    # |-0.8| - 0.6 = 0.2; 0.5 is below 0.6
    check(x2, "foot_impact_velocity", 0.2, foot_velocity=[[9.0, 9.0, -0.8], [0.0, 0.0, 0.5]])


def test_joint_position_limits(x2):
    # knee, 0 to 2.4073: middle 1.20365, 95 % of the half is 1.1434675, so 2.3471175 + 0.1 is 0.1
    # ankle roll, +-0.2967: 95 % is 0.281865, so -0.331865 is 0.05 beyond
    position = joints(x2, x2.nominal_pose, left_knee=2.4471175, right_ankle_roll=-0.331865)
    check(x2, "joint_position_limits", 0.15, joint_position=position)


def test_joint_velocity_limits(x2):
    # hip 13.936 - 11.936 = 2; ankle roll |-16.077| - 15.077 = 1; knee 11.9 is within 11.936
    speed = joints(x2, 0.0, left_hip_pitch=13.936, right_ankle_roll=-16.077, left_knee=11.9)
    check(x2, "joint_velocity_limits", 3.0, joint_velocity=speed)


def test_hip_position(x2):
    # roll 0.1^2 + yaw 0.2^2 = 0.05; the pitch is free
    position = joints(
        x2, x2.nominal_pose, left_hip_roll=0.1, right_hip_yaw=-0.2, left_hip_pitch=0.5
    )
    check(x2, "hip_position", 0.05, joint_position=position)


def test_ankle_position(x2):
    # 0.1^2 + 0.2^2 = 0.05; the pitch is free
    position = joints(
        x2, x2.nominal_pose, left_ankle_roll=0.1, right_ankle_roll=-0.2, left_ankle_pitch=0.3
    )
    check(x2, "ankle_position", 0.05, joint_position=position)


def test_stumble(x2):
    # |(3, 4)| = 5 is above 5 * 0.9 = 4.5 and not above 5 * 1
    check(x2, "stumble", 1.0, foot_force=[[0.0, 0.0, 9.0], [3.0, 4.0, -0.9]])
    check(x2, "stumble", 0.0, foot_force=[[0.0, 0.0, 9.0], [3.0, 4.0, 1.0]])
    check(x2, "stumble", 0.0, foot_force=np.zeros((2, 3)))  # a foot in the air hits nothing


def test_wall_contact(x2):
    check(x2, "wall_contact", 3.0, walls_touched=3)
    check(x2, "wall_contact", 0.0, walls_touched=0)


def test_a_perfect_stand_has_every_reward_and_no_penalty(x2):
    _, parts = rewards.total(perfect(x2), C, x2)
    weights = dict.fromkeys(rewards.TERMS, 0.0) | TABLE_1
    weights |= {"foothold_placement": 0.0}  # no foot comes down
    expected = {name: max(weight, 0.0) for name, weight in weights.items()}
    assert {name: pytest.approx(float(v), abs=1e-6) for name, v in parts.items()} == expected


@pytest.mark.parametrize(
    ("times_dt", "clip_at_zero", "expected"),
    [(True, True, 0.0), (True, False, -0.032), (False, False, -1.6), (False, True, 0.0)],
)
def test_the_sum_is_scaled_by_the_period_and_cut_at_zero(x2, times_dt, clip_at_zero, expected):
    # 2.5 + 1.5 + 1 + 1.5 + 0.1 + 0.8 = 7.4, less 3^2 is -1.6; in 0.02 s that is -0.032
    c = dataclasses.replace(C, times_dt=times_dt, clip_at_zero=clip_at_zero)
    snapshot = perfect(x2)._replace(velocity=jnp.array([0.0, 0.0, 3.0]))
    found, parts = rewards.total(snapshot, c, x2)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert float(parts["linear_velocity_z"]) == -9.0  # the log keeps it, whatever becomes of it


def test_a_touchdown_counts_for_its_own_time(x2):
    # on a foothold after 0.3 s in the air: 7.4 * 0.02 + (2 - 2.5 * (0.5 - 0.3)) * 0.25 = 0.523
    landing = walking(x2)._replace(
        first_contact=jnp.array([True, False]),
        air_time=jnp.array([0.3, PERIOD]),
        foothold_distance=jnp.array([0.0, jnp.inf]),
    )
    found, parts = rewards.total(landing, C, x2)
    assert float(found) == pytest.approx(0.523)
    assert float(parts["foothold_placement"]) == pytest.approx(2.0 * 0.25 / 0.02)
    raw, _ = rewards.total(landing, dataclasses.replace(C, times_dt=False), x2)
    assert float(raw) == pytest.approx(7.4 + 2.0 - 0.5)


def landed(x2, air_time: float, velocity_z: float = 0.0) -> float:
    """Return the reward of a step in which the left foot has come down far from any foothold."""
    landing = walking(x2)._replace(
        first_contact=jnp.array([True, False]),
        air_time=jnp.array([air_time, 0.0]),
        velocity=jnp.array([0.6, 0.0, velocity_z]),
    )
    return float(rewards.total(landing, C, x2)[0])


def test_the_cut_leaves_touchdowns_alone(x2):
    # 0.1 s in the air: 7.4 * 0.02 - 2.5 * 0.4 * 0.25 = -0.102; with 3 m/s up the rest is cut at 0
    assert landed(x2, 0.1) == pytest.approx(-0.102)
    assert landed(x2, 0.1, velocity_z=3.0) == pytest.approx(-0.25)


def test_a_cut_that_takes_touchdowns_in_makes_short_steps_free(x2):
    landing = walking(x2)._replace(
        first_contact=jnp.array([True, False]), velocity=jnp.array([0.6, 0.0, 3.0])
    )
    c = dataclasses.replace(C, clip_touchdowns=True)
    assert float(rewards.total(landing, c, x2)[0]) == 0.0


def test_two_equal_steps_never_earn_less_than_one_long_and_one_short(x2):
    for velocity_z in (0.0, 2.5, 3.0):
        for difference in (0.05, 0.13, 0.25):
            equal = 2.0 * landed(x2, 0.33, velocity_z)
            limp = landed(x2, 0.33 + difference, velocity_z) + landed(
                x2, 0.33 - difference, velocity_z
            )
            assert equal >= limp - 1e-6


def test_a_touchdown_counts_for_nothing_while_standing_is_commanded(x2):
    still = perfect(x2)
    stepping = still._replace(
        first_contact=jnp.array([True, True]),
        air_time=jnp.array([0.3, 0.7]),
        foothold_distance=jnp.zeros(2),
    )
    (of_step, parts), (of_still, _) = (rewards.total(s, C, x2) for s in (stepping, still))
    assert float(of_step) == float(of_still)
    assert all(float(parts[name]) == 0.0 for name in rewards.EVENTS)


def test_a_positive_sum_passes_the_cut(x2):
    # (7.4 - 2^2) * 0.02 = 0.068
    found, _ = rewards.total(perfect(x2)._replace(velocity=jnp.array([0.0, 0.0, 2.0])), C, x2)
    np.testing.assert_allclose(found, 0.068, rtol=1e-5)
