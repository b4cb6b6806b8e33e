"""The step of one robot: what it does with an action, and what the learner gets.

The engine is MuJoCo C. Every test steps the same eight robots, so `step` is compiled once.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilation import AS_SHIPPED
from small_world import ROBOTS, C, assert_equal, one, put

from cref_jax import config, terrain
from cref_jax.env import environment, footholds, gait, observations, rewards
from cref_jax.physics.simulation import Physics
from cref_jax.robot import kinematics
from cref_jax.terrain import cross_section

LENGTH = C.terrain.lane_length


@pytest.fixture(scope="module")
def step():
    return jax.jit(jax.vmap(environment.step, in_axes=(None, 0, 0)))


def still(robots):
    """Return actions that ask for the nominal pose."""
    return jnp.zeros((ROBOTS, robots.action.shape[-1]))


def test_a_timeout_gives_a_fresh_robot_and_the_last_state_of_the_old_one(world, step, robots):
    early, late = (
        robots.replace(step=jnp.full(ROBOTS, 500, jnp.int32)),
        robots.replace(step=jnp.full(ROBOTS, 999, jnp.int32)),
    )
    going, seen = step(world, early, still(robots))
    fresh, last = step(world, late, still(robots))
    assert last.ending.timeout.all() and last.ending.truncated.all()
    assert not last.ending.terminated.any() and not seen.ending.truncated.any()
    # the state that the step has led to, which the other robots go on from
    np.testing.assert_array_equal(last.last_privileged, seen.last_privileged)
    np.testing.assert_array_equal(seen.last_privileged, seen.observation.privileged)
    np.testing.assert_array_equal(last.reward, seen.reward)
    np.testing.assert_array_equal(going.step, 501)
    # the observation is of the fresh robot
    see = jax.vmap(lambda state: environment.observe(world, state, jax.random.key(0)))
    expected = jax.jit(see)(fresh)
    np.testing.assert_allclose(last.observation.privileged, expected.privileged, atol=1e-6)
    np.testing.assert_allclose(last.observation.velocity, expected.velocity, atol=1e-6)
    np.testing.assert_array_equal(fresh.step, 0)
    np.testing.assert_array_equal(fresh.kind, robots.kind)
    low, high = C.episode.start_x
    assert (low <= fresh.body.qpos[:, 0]).all() and (fresh.body.qpos[:, 0] <= high).all()
    assert (fresh.dynamics.friction != robots.dynamics.friction).all()  # drawn anew


def test_reaching_the_end_of_a_lane_truncates_and_raises_the_level(world, step, robots):
    is_open = np.asarray(robots.kind) == world.lanes.kinds.index("flat")
    level = robots.level
    after, outcome = step(world, put(robots, x=LENGTH - 0.9), still(robots))
    np.testing.assert_array_equal(outcome.ending.finished, ~is_open)
    np.testing.assert_array_equal(outcome.ending.truncated, ~is_open)
    np.testing.assert_array_equal(after.rank, level + ~is_open)


def test_a_robot_that_blows_up_gains_nothing_and_leaves_its_neighbours_alone(world, step, robots):
    broken = put(robots, z=robots.body.qpos[:, 2].at[3].set(jnp.nan))
    sound, expected = step(world, robots, still(robots))
    after, outcome = step(world, broken, still(robots))
    np.testing.assert_array_equal(outcome.ending.unstable, np.arange(ROBOTS) == 3)
    assert outcome.ending.terminated[3] and outcome.reward[3] == 0.0
    others = np.delete(np.arange(ROBOTS), 3)
    assert_equal(one(after, others), one(sound, others))
    assert_equal(one(outcome, others), one(expected, others))
    finite = jax.tree.map(lambda x: bool(jnp.isfinite(x).all()), (after.body, outcome.observation))
    assert all(jax.tree.leaves(finite))


def test_a_step_that_blows_up_is_judged_by_the_state_before_it(world, step, robots):
    fast = robots.replace(body=robots.body._replace(qvel=robots.body.qvel.at[2, 8].set(1e3)))
    after, outcome = step(world, fast, still(robots))
    assert outcome.ending.unstable[2] and outcome.reward[2] == 0.0
    np.testing.assert_array_equal(outcome.ending.unstable.sum(), 1)
    assert bool(jnp.isfinite(outcome.last_privileged).all())
    np.testing.assert_array_equal(after.step[2], 0)


def test_a_delayed_action_arrives_later_in_the_step(world, step, robots):
    alike = jax.tree.map(lambda x: jnp.stack([x] * ROBOTS), one(robots))
    alike = alike.replace(delay=jnp.array([0, 1, 2, 3, 4, 4, 0, 2], jnp.int32))
    calm, _ = step(world, alike, still(robots))
    moved, _ = step(world, alike, still(robots).at[:, 3].set(1.0))
    felt = np.abs(np.asarray(moved.body.qvel - calm.body.qvel)).max(axis=1)
    assert felt[4] == felt[5] == 0.0  # 20 ms: not before the next step
    assert (np.diff(felt[:5]) < 0.0).all()
    again, _ = step(world, moved, still(robots).at[:, 3].set(1.0))
    rest, _ = step(world, calm, still(robots))
    assert np.abs(np.asarray(again.body.qvel - rest.body.qvel))[4].max() > 0.1


def test_an_encoders_offset_is_seen_and_shifts_what_is_reached(world, step, robots):
    # q reads q + offset, so the target for the motor is q0 + scale * a - offset
    shift = 0.03 * jnp.sin(jnp.arange(robots.action.shape[-1]))
    straight = robots.replace(joint_offset=jnp.zeros_like(robots.joint_offset))
    straight = straight.replace(delay=jnp.zeros_like(robots.delay))
    crooked = straight.replace(joint_offset=jnp.tile(shift, (ROBOTS, 1)))
    action = 0.5 * jnp.cos(still(robots) + jnp.arange(12.0))
    by_action, _ = step(world, straight, action - shift / world.physics.robot.action_scale)
    by_offset, _ = step(world, crooked, action)
    np.testing.assert_allclose(by_offset.body.qpos, by_action.body.qpos, atol=1e-5)
    exact = dict.fromkeys((f.name for f in dataclasses.fields(config.Randomisation)), 0.0)
    exact = {name: value for name, value in exact.items() if name.startswith("noise")}
    quiet = world.replace(config=config.override(C, {"randomisation": exact}))
    part = observations.slices(12)["joint_position"]
    see = lambda state: environment.observe(quiet, one(state), jax.random.key(0))
    seen, true = see(crooked), see(straight)
    np.testing.assert_allclose(
        seen.proprioception[part] - true.proprioception[part], shift, atol=1e-6
    )
    # the critic sees the joints as they are, and the offsets
    assert (seen.privileged != true.privileged).sum() == (shift != 0.0).sum()


def test_the_same_key_gives_the_same_trajectory_and_another_one_another(world, step, robots):
    def run(state):
        for k in range(10):
            state, outcome = step(world, state, jnp.sin(k + still(robots) + jnp.arange(12.0)))
        return state, outcome

    first, again = run(robots), run(robots)
    assert_equal(first, again)
    other = run(robots.replace(key=jax.random.split(jax.random.key(99), ROBOTS)))
    assert (first[1].observation.proprioception != other[1].observation.proprioception).any()


def test_an_environment_alone_is_the_same_one_as_in_a_batch(world, step, robots):
    alone, batch = one(robots, 5), robots
    single = jax.jit(environment.step)
    for k in range(20):
        action = jnp.sin(k + still(robots) + jnp.arange(12.0))
        batch, together = step(world, batch, action)
        alone, by_itself = single(world, alone, action[5])
        # not bit for bit: XLA may round a fused sum in another order. The solver's accelerations
        # are sums of much larger numbers, so an error is measured by a tensor's largest number
        compare = lambda a, b: np.testing.assert_allclose(
            a, b, rtol=0.0, atol=2e-6 * (1.0 + np.abs(b).max())
        )
        jax.tree.map(compare, alone.body, one(batch.body, 5))
        jax.tree.map(compare, by_itself.observation, one(together.observation, 5))
        compare(by_itself.reward, together.reward[5])


def lived(world, state, force):
    """Return the state a step later and its snapshot, had it ended with this force on the feet."""
    links = world.physics.links(state.body)
    soles = footholds.soles(links, world.physics.robot)
    touching = rewards.is_touching(force, C.reward)
    feet, swings = gait.update_gait(
        state.gait, touching, C.physics.control_period, C.reward.debounce
    )
    state = state.replace(gait=feet)
    snapshot = environment._reward_snapshot(
        world, state, state.body, links, soles, force, swings, state.action
    )
    return environment._next_state(world, state, state.body, soles, snapshot), snapshot


def test_candidates_are_those_of_the_last_contact_and_judged_at_touchdown(world, robots):
    """The left foot: down, up, a scuff, up, down; the command is 0.6 m/s, so the gate is 0.3 m."""
    state = one(robots).replace(command=jnp.array([0.6, 0.0, 0.0]))
    live = jax.jit(lambda s, force: lived(world, s, force))
    up, down = (jnp.array([[0.0, 0.0, left], [0.0, 0.0, 200.0]]) for left in (0.0, 200.0))
    assert not state.candidates.accepted.any()
    standing, _ = live(state, down)
    assert standing.candidates.accepted.any(axis=1).tolist() == [True, True]
    swung = standing
    for k, force in enumerate((up, up, down, up)):
        swung, snapshot = live(put(swung, x=standing.body.qpos[0] + 0.11 * (k + 1)), force)
        assert not snapshot.first_contact.any()
        left = jax.tree.map(lambda x: x[0], (swung.candidates, standing.candidates))
        jax.tree.map(np.testing.assert_array_equal, *left)
    # level ground; the nearest window of points past 0.3 m has its mean at 0.32 m, and each 4 cm
    # further there is another: the foot, turned a little from the lane, is about 0.44 m ahead
    assert snapshot.foothold_distance[0] < 0.02
    touched, first = live(swung, down)
    assert not first.first_contact.any()  # it may be a scuff, too
    _, landed = live(touched, down)
    assert landed.first_contact.tolist() == [True, False]
    assert float(landed.air_time[0]) == pytest.approx(5 * 0.02)
    placed = rewards.foothold_placement(landed, C.reward, world.physics.robot)
    assert float(placed) > np.exp(-0.02 / 0.08)


def test_contacts_time_the_phases_of_a_gait(world, robots):
    """Seven steps of 20 ms: both feet, thrice the right one, twice both, the left one."""
    state = one(robots)
    live = jax.jit(lambda s, force: lived(world, s, force))
    on_ground = [(1, 1), (0, 1), (0, 1), (0, 1), (1, 1), (1, 1), (1, 0)]
    first, ended, air, since = [], [], [], []
    for touching in on_ground:
        # 5 N and less do not count
        force = jnp.array([[0.0, 0.0, 200.0 if foot else 5.0] for foot in touching])
        state, snapshot = live(state, force)
        first.append(snapshot.first_contact.tolist())
        ended.append(snapshot.air_time.tolist())
        air.append(state.gait.air_time.tolist())
        since.append(float(snapshot.since_single))
    # the start counts as on the ground, so only the left foot comes down: confirmed in step 6
    assert first == [[k == 5, False] for k in range(7)]
    # off the ground in steps 2 to 4: the contact comes within 0.08 s of leaving
    np.testing.assert_allclose(ended[5][0], 0.08, atol=1e-6)
    left = [0, 0, 0.04, 0.06, 0.08, 0, 0]  # up from the second step without contact
    np.testing.assert_allclose(air, [[x, 0] for x in left], atol=1e-6)
    # one foot is down alone in steps 3 to 5; a lift of one step, the last, pays no single contact
    np.testing.assert_allclose(since, [0.02, 0.04, 0, 0, 0, 0.02, 0.04], atol=1e-6)


def test_the_support_stays_at_its_last_height_while_both_feet_are_in_the_air(world, robots):
    state = one(robots)
    links = world.physics.links(state.body)
    feet = np.asarray(links.position[world.physics.feet, 2])
    down = jnp.array([[0.0, 0.0, 9.0], [0.0, 0.0, 0.0]])
    left, _ = lived(world, state, down)
    np.testing.assert_allclose(left.support_z, feet[0], atol=1e-6)
    up, _ = lived(world, put(left, z=2.0), 0.0 * down)
    np.testing.assert_array_equal(up.support_z, left.support_z)


def random_walk(world, state, steps: int):
    """Return every step's outcome under actions from a normal distribution."""

    def once(state, key):
        action = jax.random.normal(key, state.action.shape)
        state, outcome = jax.vmap(environment.step, in_axes=(None, 0, 0))(world, state, action)
        finite = jax.tree.map(lambda x: jnp.isfinite(x).all(), (state.body, outcome.observation))
        sound = jnp.stack(jax.tree.leaves(finite)).all() & jnp.isfinite(outcome.reward).all()
        return state, (sound, outcome.ending)

    keys = jax.random.split(jax.random.key(0), steps)
    return jax.jit(lambda s: jax.lax.scan(once, s, keys)[1])(state)


@pytest.mark.slow
def test_256_robots_survive_10_s_of_random_actions(world, fresh_states):
    sound, ending = random_walk(world, one(fresh_states, np.arange(256)), steps=500)
    assert sound.all() and not ending.unstable.any()
    assert ending.terminated.sum() > 256  # they have fallen, and gone on


@pytest.mark.slow
def test_64_robots_survive_2_s_of_random_actions_in_mjx(world, fresh_states):
    in_mjx = world.replace(physics=Physics(C.robot, C.physics, "mjx"))
    sound, ending = random_walk(in_mjx, one(fresh_states, np.arange(64)), steps=100)
    assert sound.all() and not ending.unstable.any()


def test_all_robots_step_as_each_would_alone(world, robots):
    # a command is due for robot 2, a push for robot 4, and the episode of robot 1 is over
    state = robots.replace(
        command_left=robots.command_left.at[2].set(1),
        push_left=robots.push_left.at[4].set(1),
        step=robots.step.at[1].set(997),
    )
    jit = functools.partial(jax.jit, compiler_options=AS_SHIPPED)
    together = jit(environment.step_all)
    each = jit(jax.vmap(environment.step, in_axes=(None, 0, 0)))
    both = state, state
    ended = 0
    for _ in range(4):
        action = 0.3 * jnp.ones((8, 12))
        (ours, said), (theirs, expected) = (
            step(world, s, action) for step, s in zip((together, each), both, strict=True)
        )
        # not bit for bit: they are two programs, and XLA may round a sum in another order
        near = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
        jax.tree.map(near, (ours.body, said.observation), (theirs.body, expected.observation))
        a, b = (jax.tree.leaves(x) for x in ((ours, said), (theirs, expected)))
        for mine, other in zip(a, b, strict=True):
            if jnp.issubdtype(mine.dtype, jnp.floating):
                np.testing.assert_allclose(mine, other, rtol=1e-4, atol=1e-4)
            else:
                assert_equal(mine, other)
        both, ended = (ours, theirs), ended + int(said.ending.timeout.sum())
    assert ended == 1
    assert float(ours.command[2, 0]) != float(state.command[2, 0])


@pytest.mark.parametrize(
    ("gap", "lift", "expected"), [(0.995, 0.05, 1), (1.005, 0.05, 0), (0.995, 0.0, 0)]
)
def test_a_sphere_is_at_a_wall_if_that_is_the_nearest_it_touches(
    world, robots, gap, lift, expected
):
    # the foremost sphere is a little less than its radius from a riser, or more; where it stands,
    # the ground is nearer
    physics, state = world.physics, one(robots)
    spheres = physics.robot.spheres
    qpos = state.body.qpos.at[:2].set(0.0).at[3:7].set(jnp.array([1.0, 0.0, 0.0, 0.0]))
    centres = lambda qpos: kinematics.points(
        physics.links(state.body._replace(qpos=qpos)), spheres.body, spheres.position
    )
    front = int(np.argmax(centres(qpos)[:, 0]))
    x, _, z = centres(qpos)[front]
    radius = float(spheres.radius[front])
    qpos = qpos.at[0].set(1.0 - x - gap * radius).at[2].add(lift + 0.99 * radius - z)
    ground = terrain.from_heights(0.2 * (jnp.arange(100) >= 50)[:, None], 0.02)
    links = physics.links(state.body._replace(qpos=qpos))
    assert int(physics.at_wall(ground, links)[front]) == expected


def test_walls_are_looked_for_if_they_cost_something(world, step, robots):
    costly = config.override(world.config, {"reward": {"weights": {"wall_contact": -5.0}}})
    stairs = np.flatnonzero(np.asarray(robots.kind) == world.lanes.kinds.index("stairs_up"))[0]
    tile = world.lanes.tile(2, int(robots.kind[stairs]), int(robots.variant[stairs]))
    riser = cross_section.from_lane(tile).left[1]
    links = world.physics.links(one(robots.body, stairs))
    spheres = world.physics.robot.spheres
    toes = kinematics.points(links, spheres.body, spheres.position)[:, 0].max()
    x = robots.body.qpos[:, 0].at[stairs].add(riser - toes)  # into the riser by a radius
    state = put(robots, x=x).replace(level=robots.level.at[stairs].set(2))
    _, seen = step(world, state, still(robots))
    assert (seen.measures.terms["wall_contact"] == 0.0).all()
    _, seen = step(world.replace(config=costly), state, still(robots))
    found = seen.measures.terms["wall_contact"]
    assert float(found[stairs]) <= -5.0 and float(found[stairs]) % -5.0 == 0.0
    assert (np.delete(found, stairs) == 0.0).all()


@pytest.mark.parametrize(("gap", "expected"), [(-0.001, True), (0.001, False)])
def test_links_that_are_kept_clear_have_hit_the_ground_where_they_touch_it(
    world, robots, gap, expected
):
    physics = world.physics
    links, capsules = physics.links(one(robots).body), physics.robot.capsules
    clear = np.tile(capsules.kept_clear, 2)
    ends = np.concatenate([capsules.start, capsules.end])[clear]
    body, radius = np.tile(capsules.body, 2)[clear], np.tile(capsules.radius, 2)[clear]
    lowest = float((kinematics.points(links, body, ends)[:, 2] - radius).min())
    ground = terrain.from_heights(np.full((200, 200), lowest - gap), 0.1, (-10.0, -10.0))
    assert bool(physics.is_hit(ground, links)) == expected
