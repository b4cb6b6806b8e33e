"""An episode of one robot: its start, what disturbs it, how it ends and what follows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_world
from small_world import ROBOTS, C, assert_equal, on, one, put

from cref_jax import config, geometry, terrain
from cref_jax.env import commands, curriculum, events, resets, terminations
from cref_jax.env.state import Draws, Ending, Spread, even_spread
from cref_jax.robot import kinematics

LENGTH = C.terrain.lane_length
PERIOD = C.physics.control_period


# The start


def test_a_robot_starts_from_a_settled_state_turned_and_moved_in_its_lane(world, fresh_states):
    c, bank = C.episode, world.bank
    qpos, qvel = np.asarray(fresh_states.body.qpos), np.asarray(fresh_states.body.qvel)
    same = (qpos[:, None, 7:] == np.asarray(bank.qpos)[None, :, 7:]).all(-1)
    assert same.sum(axis=1).tolist() == [1] * len(qpos)  # one state of the bank, its joints as is
    assert same.any(axis=0).all()  # and each of them is used
    source = same.argmax(axis=1)
    np.testing.assert_array_equal(qpos[:, 2], bank.qpos[source, 2])
    np.testing.assert_array_equal(qvel[:, 3:], bank.qvel[source, 3:])
    for column, (low, high) in ((0, c.start_x), (1, c.start_y)):
        assert low <= qpos[:, column].min() < low + 0.05
        assert high - 0.05 < qpos[:, column].max() <= high
    np.testing.assert_array_equal(fresh_states.start, qpos[:, :2])
    turn = np.asarray(
        geometry.yaw(fresh_states.body.qpos[:, 3:7]) - geometry.yaw(bank.qpos[source, 3:7])
    )
    assert 0.95 * c.yaw_jitter < np.abs(turn).max() <= c.yaw_jitter + 1e-5
    own_frame = lambda body: geometry.rotate_inverse(body.qpos[:, 3:7], body.qvel[:, :3])
    expected = own_frame(one(world.bank, source))
    np.testing.assert_allclose(own_frame(fresh_states.body), expected, atol=1e-6)


def test_a_robot_starts_standing_on_its_lane(world, fresh_states):
    spheres = world.physics.robot.spheres

    def clearance(state):
        ground = world.lanes.tile(state.level, state.kind)
        links = world.physics.links(state.body)
        centre = kinematics.points(links, spheres.body, spheres.position)
        return centre[:, 2] - spheres.radius - terrain.height_at(ground, centre[:, :2])

    lowest = np.asarray(jax.jit(jax.vmap(clearance))(fresh_states)).min(axis=1)
    assert lowest.min() > -0.005 and lowest.max() < 0.001
    assert np.abs(fresh_states.body.qvel[:, :3]).max() < 0.2
    np.testing.assert_array_equal(fresh_states.step, 0)


def test_a_share_of_the_robots_starts_on_any_level_stretch_before_the_last_obstacle(
    world, fresh_states
):
    c = config.override(C, {"episode": {"start_anywhere": 0.5}})
    reset = jax.jit(jax.vmap(resets.reset, in_axes=(None, 0, 0, 0)))
    keys = jax.random.split(jax.random.key(3), 512)
    state = reset(world.replace(config=c), keys, fresh_states.kind, jnp.full(512, 2))
    x, kinds = np.asarray(state.body.qpos[:, 0]), np.array(world.lanes.kinds)[state.kind]
    usual = x[kinds == "flat"]  # whoever is not elsewhere starts anywhere from 0.5 to 1 m
    assert (usual < 0.6).any() and (usual > 0.9).any()
    away = x > 1.1  # m; the level start is 1.5 m long
    assert not away[(kinds == "flat") | (kinds == "rough")].any()  # nothing lies ahead there
    assert 0.15 < away[kinds == "gap"].mean() < 0.6  # half of the places are at the start, too

    def ground(state, offset):
        place = state.body.qpos[:2] + jnp.array([offset, 0.0])
        tile = world.lanes.tile(state.level, state.kind, state.variant)
        return terrain.height_at(tile, place)

    under, *around = (jax.vmap(ground, (0, None))(state, by) for by in (0.0, -0.4, 0.4))
    for there in around:
        np.testing.assert_array_equal(under[away], there[away])
    assert float(jnp.abs(under[away]).max()) > 0.15  # on landings and boxes, too
    assert float(under[kinds == "gap"].min()) == 0.0  # not in a trench
    rise = state.body.qpos[:, 2] - under
    np.testing.assert_allclose(rise, fresh_states.body.qpos[:, 2].mean(), atol=0.02)


def test_half_of_the_randomisation_is_half_as_wide(world, fresh_states):
    kinds, levels = fresh_states.kind, fresh_states.level
    keys = jax.random.split(jax.random.key(3), 512)  # those of `fresh_states`
    reset = jax.jit(jax.vmap(resets.reset, in_axes=(None, 0, 0, 0, None)))
    nominal = world.physics.nominal_dynamics()
    for share in (0.0, 0.5):
        state = reset(world, keys, kinds, levels, even_spread(share))
        for part, whole, middle in zip(
            *map(jax.tree.leaves, (state.dynamics, fresh_states.dynamics, nominal)), strict=True
        ):
            np.testing.assert_allclose(
                part, middle + share * (whole - middle), rtol=1e-4, atol=1e-5
            )
        for name in ("joint_offset", "camera_pitch", "camera_shift"):
            np.testing.assert_allclose(
                getattr(state, name), share * getattr(fresh_states, name), rtol=1e-5
            )
        assert int(state.delay.max()) == {0.0: 0, 0.5: 2}[share]


def test_drawn_dynamics_stay_in_their_ranges_and_fill_them(world, fresh_states):
    r, nominal = C.randomisation, world.physics.nominal_dynamics()
    drawn = fresh_states.dynamics
    for values, low, high in (
        (drawn.friction, *r.friction),
        (drawn.payload, -r.trunk_mass, r.trunk_mass),
        (drawn.com_shift, -r.trunk_com, r.trunk_com),
        (drawn.kp / nominal.kp, *r.gains),
        (drawn.kd / nominal.kd, *r.gains),
        (fresh_states.joint_offset, -r.joint_offset, r.joint_offset),
    ):
        values, slack = np.asarray(values), 1e-5 * (high - low)
        assert (values.min(axis=0) >= low - slack).all() and (
            values.max(axis=0) <= high + slack
        ).all()
        assert (np.ptp(values, axis=0) > 0.97 * (high - low)).all()
    # 0 to 20 ms in substeps of 5 ms
    assert sorted(set(np.asarray(fresh_states.delay).tolist())) == [0, 1, 2, 3, 4]


def test_without_randomisation_every_robot_is_the_nominal_one(world):
    c = config.override(C, {"randomisation": {"enabled": False}})
    state = resets.reset(world.replace(config=c), jax.random.key(0), jnp.int32(1), jnp.int32(0))
    assert_equal(state.dynamics, world.physics.nominal_dynamics())
    assert not state.joint_offset.any() and int(state.delay) == 0


@pytest.mark.parametrize("part", [*Spread._fields, None])
def test_each_part_is_randomised_alone(world, part):
    share = Spread(*(jnp.float32(name == part) for name in Spread._fields))
    keys = jax.random.split(jax.random.key(6), 32)
    reset = jax.vmap(resets.reset, in_axes=(None, 0, None, None, None))
    nominal = reset(world, keys, jnp.int32(1), jnp.int32(0), even_spread(0.0))
    state = reset(world, keys, jnp.int32(1), jnp.int32(0), share)
    fields = {
        "friction": lambda s: s.dynamics.friction,
        "mass": lambda s: (s.dynamics.payload, s.dynamics.com_shift),
        "gains": lambda s: (s.dynamics.kp, s.dynamics.kd),
        "offsets": lambda s: s.joint_offset,
        "delay": lambda s: s.delay,
        "camera": lambda s: (s.camera_pitch, s.camera_shift),
    }
    assert_equal(one(nominal).dynamics, world.physics.nominal_dynamics())
    for name, field in fields.items():
        if name == part:
            for a, b in zip(*map(jax.tree.leaves, (field(state), field(nominal))), strict=True):
                assert (a != b).mean() > 0.7
        else:
            assert_equal(field(state), field(nominal))
    shoved = jax.vmap(events.apply_push, in_axes=(None, 0, None))
    due, draw = state.replace(push_left=jnp.zeros(32, jnp.int32)), jnp.array([0.5, -0.3])
    none = jnp.int32(0)
    draws = Draws(draw, jnp.float32(0.7), none, jnp.zeros(3), jnp.array(False), none)
    gained = shoved(world, due, draws).body.qvel - state.body.qvel
    np.testing.assert_allclose(gained[:, :2], jnp.tile(draw * (part == "pushes"), (32, 1)))
    np.testing.assert_array_equal(gained[:, 5], 0.0)  # the default turns nobody


def test_a_push_turns_the_base_where_it_is_asked_to(world, fresh_states):
    c = config.override(C, {"randomisation": {"push_yaw_rate": 1.5}})
    state = jax.tree.map(lambda x: x[:64], fresh_states)
    state = state.replace(push_left=jnp.zeros(64, jnp.int32))
    world = world.replace(config=c)
    push = lambda s, k: events.apply_push(world, s, events.draw(world, s, k, k))
    after = jax.vmap(push)(state, jax.random.split(jax.random.key(1), 64))
    turn = np.asarray(after.body.qvel - state.body.qvel)[:, 5]
    assert 1.0 < turn.max() <= 1.5 and -1.5 <= turn.min() < -1.0
    assert np.abs(np.corrcoef(turn, np.asarray(after.body.qvel)[:, 0])[0, 1]) < 0.4


# The command


def test_on_a_lane_most_commands_go_forward_and_on_open_ground_anywhere(world, fresh_states):
    c, command = C.command, np.asarray(fresh_states.command)
    is_open = np.asarray(fresh_states.kind) == world.lanes.kinds.index("flat")
    is_steered = np.asarray(fresh_states.is_steered)
    assert not is_steered[is_open].any()
    assert 0.85 < is_steered[~is_open].mean() < 0.95  # all but a tenth
    elsewhere = command[~is_open & ~is_steered]
    assert 0.3 < (elsewhere == 0.0).all(axis=1).mean() < 0.7  # a half of those stands
    assert (np.abs(elsewhere[:, 1:]).max(axis=0) > [0.1, 0.3]).all()
    along = command[is_steered]
    assert c.lane_vx[0] <= along[:, 0].min() and along[:, 0].max() <= c.lane_vx[1]
    np.testing.assert_array_equal(along[:, 1:], 0.0)
    free = command[is_open]
    standing = (free == 0.0).all(axis=1)
    assert 0 < standing.sum() < 0.3 * len(free)
    for column, (low, high) in enumerate((c.vx, c.vy, c.yaw_rate)):
        assert low <= free[:, column].min() and free[:, column].max() <= high
        assert np.ptp(free[:, column]) > 0.8 * (high - low)


def test_parts_of_a_command_in_the_open_are_0_at_times(world, fresh_states):
    c = config.override(C, {"command": {"zero": 0.5, "standing": 0.0}})
    draw = jax.vmap(commands.sample_command, in_axes=(None, 0, None))
    keys, flat = jax.random.split(jax.random.key(4), 2000), world.lanes.kinds.index("flat")
    command, _ = draw(world.replace(config=c), keys, jnp.int32(flat))
    is_zero = np.asarray(command) == 0.0
    np.testing.assert_allclose(is_zero.mean(axis=0), 0.5, atol=0.05)
    on_the_spot = is_zero[:, 0] & is_zero[:, 1] & ~is_zero[:, 2]
    assert on_the_spot.mean() == pytest.approx(0.125, abs=0.03)  # a half of a half of a half
    before, _ = draw(world, keys, jnp.int32(flat))  # the others are drawn as ever
    stands = (np.asarray(before) == 0.0).all(axis=1)
    moves = ~is_zero & ~stands[:, None]
    np.testing.assert_array_equal(np.asarray(command)[moves], np.asarray(before)[moves])


def commanded(world, state, seed=0):
    draws = events.draw(world, state, jax.random.key(9), jax.random.key(seed))
    return commands.update_command(world, state, draws)


def pushed(world, state, key):
    return events.apply_push(world, state, events.draw(world, state, key, jax.random.key(9)))


@pytest.mark.parametrize(
    ("y", "heading", "expected"),
    [
        (0.1, 0.0, -0.3),  # 1.5 rad/m * 0.1 m to the right, by 2 rad/s a radian
        (0.1, 0.1, -0.5),  # and 0.1 rad more, as it heads to the left
        (0.0, -0.2, 0.4),
        (3.0, -0.4, -0.2),  # no more than 0.5 rad off the lane's direction, 0.1 to be added
        (3.0, 0.3, -0.6),  # the limit of the yaw rate
        (0.0, 3.1, -0.6),  # the short way round
        (0.0, -3.1, 0.6),
    ],
)
def test_a_robot_on_a_lane_is_steered_to_its_middle(world, robots, y, heading, expected):
    state = on("gap", one(robots)).replace(command_left=jnp.int32(9), is_steered=jnp.array(True))
    about_z = geometry.quat_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.float32(heading))
    steered = commanded(world, put(state, y=y, rotation=about_z))
    np.testing.assert_allclose(steered.command[2], expected, atol=1e-5)
    np.testing.assert_array_equal(steered.command[:2], state.command[:2])


def test_whoever_obeys_the_steering_ends_in_the_middle_of_the_lane(world, robots):
    state = on("gap", one(robots)).replace(command=jnp.array([0.5, 0.0, 0.0]))
    state = state.replace(is_steered=jnp.array(True))

    def walk(pose, _):
        x, y, heading = pose
        rotation = geometry.quat_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), heading)
        here = put(state, x=x, y=y, rotation=rotation).replace(command_left=jnp.int32(9))
        vx, _, rate = commanded(world, here).command * PERIOD
        return (x + vx * jnp.cos(heading), y + vx * jnp.sin(heading), heading + rate), None

    start = (jnp.float32(0.5), jnp.float32(0.4), jnp.float32(0.9))
    (x, y, heading), _ = jax.jit(lambda s: jax.lax.scan(walk, s, None, length=1000))(start)
    assert abs(y) < 0.05 and abs(heading) < 0.05 and x > 9.0  # 20 s at 0.5 m/s


def test_on_open_ground_the_yaw_rate_is_the_drawn_one(world, robots):
    state = on("flat", one(robots))
    state = put(state, y=0.5).replace(
        command=jnp.array([0.5, 0.1, 0.7]), command_left=jnp.int32(9), is_steered=jnp.array(False)
    )
    after = commanded(world, state)
    np.testing.assert_array_equal(after.command, state.command)
    # |(0.5, 0.1)| * 0.02 s
    np.testing.assert_allclose(after.commanded - state.commanded, 0.51 * PERIOD, rtol=1e-3)


def test_a_robot_that_is_told_to_stand_or_to_turn_on_a_lane_is_not_steered(world, robots):
    state = put(on("gap", one(robots)), y=0.5)
    for command in ([0.0, 0.0, 0.0], [0.0, 0.0, 0.8], [0.3, -0.2, 0.1]):
        told = state.replace(
            command=jnp.array(command), command_left=jnp.int32(9), is_steered=jnp.array(False)
        )
        after = commanded(world, told)
        np.testing.assert_array_equal(after.command, told.command)
        assert float(after.commanded) == float(told.commanded)  # no way along the lane is asked for


def test_a_new_command_is_drawn_only_when_it_is_due(world, robots):
    state = on("gap", one(robots))
    kept = commanded(world, state.replace(command_left=jnp.int32(1)), seed=1)
    assert float(kept.command[0]) == float(state.command[0]) and int(kept.command_left) == 0
    drawn = commanded(world, kept, seed=1)
    assert float(drawn.command[0]) != float(state.command[0])
    assert 400 <= int(drawn.command_left) <= 600  # 8 to 12 s


# Pushes


def test_a_push_changes_the_planar_velocity_and_only_when_due(world, robots):
    state = one(robots)
    waits = pushed(world, state.replace(push_left=jnp.int32(1)), jax.random.key(0))
    assert_equal(waits.body, state.body)
    assert int(waits.push_left) == 0
    keys = jax.random.split(jax.random.key(0), 300)
    after = jax.vmap(lambda key: pushed(world, waits, key))(keys)
    change = np.asarray(after.body.qvel - state.body.qvel)
    np.testing.assert_array_equal(change[:, 2:], 0.0)
    assert 0.95 < np.abs(change[:, :2]).max() <= C.randomisation.push_velocity + 1e-6
    assert np.abs(change[:, :2].mean(axis=0)).max() < 0.15
    np.testing.assert_array_equal(after.body.qpos, np.tile(state.body.qpos, (300, 1)))
    assert (after.push_left >= 250).all() and (after.push_left <= 500).all()  # 5 to 10 s


def test_nobody_is_pushed_without_randomisation(world, robots):
    calm = world.replace(config=config.override(C, {"randomisation": {"enabled": False}}))
    state = one(robots).replace(push_left=jnp.int32(0))
    assert_equal(pushed(calm, state, jax.random.key(0)), state)


# The end


@pytest.fixture(scope="module")
def causes():
    world = small_world.world()
    judge = jax.jit(
        lambda state: terminations.check_termination(
            world, state, world.physics.links(state.body), jnp.zeros((), bool)
        )
    )
    return lambda state: {name for name, value in judge(state)._asdict().items() if value}


def tilted_by(angle: float):
    return geometry.quat_from_axis_angle(jnp.array([0.6, 0.8, 0.0]), jnp.float32(angle))


def test_a_robot_that_stands_goes_on(causes, robots):
    for index in range(ROBOTS):
        assert causes(one(robots, index)) == set()


def test_too_much_tilt_ends_it(causes, robots):
    aloft = put(one(robots), z=1.2)  # where nothing touches
    assert causes(put(aloft, rotation=tilted_by(1.02))) == {"tilted"}
    assert causes(put(aloft, rotation=tilted_by(0.98))) == set()
    assert causes(put(aloft, rotation=tilted_by(3.1))) == {"tilted"}


def test_a_pelvis_too_near_to_the_support_ends_it(causes, robots):
    state = one(robots)
    z = float(state.body.qpos[2])
    assert causes(state.replace(support_z=jnp.float32(z - 0.14))) == {"low"}
    assert causes(state.replace(support_z=jnp.float32(z - 0.16))) == set()


def test_a_body_in_the_terrain_ends_it(world, causes, robots):
    # standing in the middle of a box of 0.4 m, the thighs are in it
    state = on("platform", one(robots), level=2)
    line = jnp.stack([jnp.linspace(1.5, 6.0, 451), jnp.zeros(451)], axis=1)
    heights = np.asarray(terrain.height_at(world.lanes.tile(2, state.kind), line))
    inside = float(line[np.flatnonzero(heights > 0.39)[50], 0])
    assert causes(put(state, x=inside)) == {"hit"}
    assert causes(put(state, x=inside, z=state.body.qpos[2] + 0.4)) == set()


def test_a_foot_far_below_the_last_support_ends_it(causes, robots):
    # a leg is 0.6 m long, so this comes with a low pelvis unless the robot has gone down sideways
    state = one(robots)
    ankle = float(state.body.qpos[2]) - 0.55
    assert causes(state.replace(support_z=jnp.float32(ankle + 0.53))) == {"dropped", "low"}
    assert causes(state.replace(support_z=jnp.float32(ankle + 0.47))) == {"low"}


def test_the_end_of_a_lane_is_a_success_and_open_ground_has_none(world, causes, robots):
    state = put(one(robots), x=LENGTH - 0.99)
    assert causes(on("gap", state)) == {"finished"}
    assert causes(on("flat", state)) == set()
    assert causes(on("gap", put(state, x=LENGTH - 1.01))) == set()


@pytest.mark.parametrize(
    ("kind", "step", "came", "expected"),
    [
        ("gap", 500, 0.89, {"stalled"}),  # less than 0.3 of the 3 m since the last look
        ("gap", 500, 0.91, set()),
        ("gap", 499, 0.0, set()),  # looked at each 5 s only
        ("flat", 500, 0.0, set()),  # in the open it may be told to stand
    ],
)
def test_a_robot_that_stands_in_its_lane_has_stalled(causes, robots, kind, step, came, expected):
    state = put(one(robots), x=2.0 + came)
    state = state.replace(
        step=jnp.int32(step), mark=jnp.array([2.0, 4.0]), commanded=jnp.float32(7.0)
    )
    assert causes(on(kind, state)) == expected


def test_who_was_told_to_stand_in_between_has_not_stalled(causes, robots):
    # 2 m asked for in 5 s is 0.4 m/s throughout, the slowest command; 1.8 m is not
    state = put(one(robots), x=2.0).replace(step=jnp.int32(500), mark=jnp.array([2.0, 4.0]))
    assert causes(on("gap", state.replace(commanded=jnp.float32(6.0)))) == {"stalled"}
    assert causes(on("gap", state.replace(commanded=jnp.float32(5.8)))) == set()


def test_a_look_is_noted(world, robots):
    state = put(one(robots), x=3.0).replace(commanded=jnp.float32(2.5))
    for step, expected in ((250, [3.0, 2.5]), (251, np.asarray(state.mark))):
        found = terminations.record_progress(world, state.replace(step=jnp.int32(step))).mark
        np.testing.assert_allclose(found, expected)


def test_time_runs_out_after_20_s(causes, robots):
    assert causes(one(robots).replace(step=jnp.int32(1000))) == {"timeout"}
    assert causes(one(robots).replace(step=jnp.int32(999))) == set()


@pytest.mark.parametrize("cause", Ending._fields)
def test_only_an_end_without_a_failure_truncates(cause):
    fails = cause not in ("finished", "timeout", "stalled")
    over = Ending(*(jnp.array(name == cause) for name in Ending._fields))
    assert bool(over.terminated) == fails and bool(over.truncated) != fails
    both = over._replace(timeout=jnp.array(True))
    assert bool(both.terminated) == fails and bool(both.truncated) != fails


# The curriculum


@pytest.mark.parametrize(
    ("walked", "commanded", "level", "cause", "expected"),
    [
        (6.1, 9.0, 0, "timeout", 1),  # more than half of the 12 m
        (5.9, 9.0, 0, "timeout", 0),  # more than half of what was asked for: stays
        (5.9, 9.0, 1, "timeout", 1),
        (4.4, 9.0, 1, "timeout", 0),  # less than half of it
        (0.1, 9.0, 0, "tilted", 0),  # never below the easiest
        (11.0, 9.0, 1, "tilted", 1),  # far, but fell
        (6.1, 9.0, 1, "stalled", 1),  # far, but stands now
        (1.0, 1.0, 1, "tilted", 0),  # fell early, in the first metre of the 9 to come
        (3.0, 9.0, 1, "finished", 2),  # reached the end, however long the lane was
    ],
)
def test_a_rank_is_won_and_lost(world, robots, walked, commanded, level, cause, expected):
    rank, next_level = after(world, robots, walked, commanded, level, level, cause, review=0.0)
    assert int(rank) == int(next_level) == expected


@pytest.mark.parametrize("walked", [-0.001, 0.001])
def test_who_is_told_to_stand_all_the_time_keeps_the_rank(world, robots, walked):
    over = Ending(*(jnp.array(name == "timeout") for name in Ending._fields))
    state = one(robots).replace(
        rank=jnp.int32(1),
        level=jnp.int32(1),
        commanded=jnp.float32(0.0),
        command=jnp.zeros(3),
        is_steered=jnp.array(False),
        step=jnp.int32(1000),
    )
    state = put(state, x=state.start[0] + walked)
    rank, _ = curriculum.next_level(world, state, over, jax.random.key(0))
    assert int(rank) == 1


def test_a_lane_is_only_passed_from_its_start(world, robots):
    over = Ending(*(jnp.array(name == "finished") for name in Ending._fields))
    state = put(on("gap", one(robots)), x=11.0).replace(
        rank=jnp.int32(0), commanded=jnp.float32(9.0)
    )
    for start, expected in ((0.9, 1), (6.0, 0)):
        rank, _ = curriculum.next_level(
            world, state.replace(start=jnp.array([start, 0.0])), over, jax.random.key(0)
        )
        assert int(rank) == expected


def test_no_more_is_asked_for_than_the_lane_is_long(world, robots):
    # 1 m/s for 20 s is 20 m, the way from 0.75 m to the finish at 11 m is 10.25 m
    state = one(robots).replace(command=jnp.array([1.0, 0.0, 0.0]), start=jnp.array([0.75, 0.0]))
    state = state.replace(is_steered=jnp.array(True))
    assert float(curriculum._commanded_distance(world, state)) == pytest.approx(10.25)
    slow = state.replace(command=jnp.array([0.3, 0.4, 0.0]), step=jnp.int32(500))
    assert float(curriculum._commanded_distance(world, slow)) == pytest.approx(
        5.0
    )  # 0.5 m/s for 10 s


def after(world, robots, walked, commanded, level, rank, cause, review, key=0):
    """Return rank and next level of a robot that walked so far on a lane of this level."""
    c = config.override(C, {"curriculum": {"review": review}})
    # at 0.5 m/s, so that the rest of the 20 s asks for what is left of 9 m
    step = jnp.int32(round((20.0 - (9.0 - commanded) / 0.5) / 0.02))
    state = one(robots).replace(
        level=jnp.int32(level),
        rank=jnp.int32(rank),
        commanded=jnp.float32(commanded),
        command=jnp.array([0.5, 0.0, 0.0]),
        is_steered=jnp.array(True),
        step=step,
    )
    state = put(state, x=state.start[0] + walked)
    over = Ending(*(jnp.array(name == cause) for name in Ending._fields))
    return curriculum.next_level(world.replace(config=c), state, over, jax.random.key(key))


def test_an_easy_level_neither_wins_nor_costs_a_rank(world, robots):
    for walked, cause in ((11.0, "finished"), (0.1, "tilted")):
        rank, next_level = after(world, robots, walked, 9.0, 0, 1, cause, review=0.0)
        assert int(rank) == int(next_level) == 1


def test_a_share_of_the_episodes_is_on_any_level_up_to_the_rank(world, robots):
    draws = [after(world, robots, 5.9, 9.0, 2, 2, "timeout", 0.5, key) for key in range(200)]
    assert {int(rank) for rank, _ in draws} == {2}
    share = np.bincount([int(level) for _, level in draws], minlength=3) / len(draws)
    # half of them review, a third of those each level: 1/6, 1/6, 2/3; three deviations are 0.1
    np.testing.assert_allclose(share, [1 / 6, 1 / 6, 2 / 3], atol=0.1)


def test_beyond_the_hardest_level_comes_a_random_one(world, robots):
    passed = [after(world, robots, 9.0, 9.0, 2, 2, "finished", 0.0, key) for key in range(60)]
    assert {int(rank) for rank, _ in passed} == {2}
    assert {int(level) for _, level in passed} == {0, 1, 2}


def test_without_a_curriculum_the_level_stays(world, robots):
    fixed = world.replace(config=config.override(C, {"curriculum": {"enabled": False}}))
    state = put(one(robots).replace(level=jnp.int32(1)), x=11.0)
    over = Ending(*(jnp.array(name == "finished") for name in Ending._fields))
    assert int(curriculum.next_level(fixed, state, over, jax.random.key(0))[1]) == 1
