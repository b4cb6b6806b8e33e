"""The physics step against MuJoCo C: engine against engine, tangent planes against real boxes.

One lane holds level ground, stairs, a gap and a platform. Every test steps the same number of
robots by one substep, so each engine is compiled once.
"""

import dataclasses
import importlib.util
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from cref_jax import config, errors, geometry, robot, terrain
from cref_jax.physics.records import Body, Dynamics, SubstepInput
from cref_jax.physics.simulation import Physics, resolve_engine
from cref_jax.robot import kinematics

ROBOTS = 200
CELL = 0.02  # m
LANE = [  # m, length and height of the stretches
    (2.0, 0.0),
    (0.3, 0.15),
    (0.3, 0.30),
    (0.3, 0.45),
    (1.5, 0.60),
    (0.5, -0.40),
    (1.5, 0.60),
    (1.2, 0.90),
    (1.5, 0.60),
]
AT = {"flat": (0.5, 1.5), "stairs": (1.8, 3.0), "gap": (4.1, 4.6), "platform": (6.2, 6.6)}  # m, x
RISER = 2.0  # m, x of the first step's front, 0.15 m high
ONE_SUBSTEP = dataclasses.replace(config.Physics(), substeps=1)
TIMESTEP = ONE_SUBSTEP.timestep
GRAVITY = 9.81  # m/s^2
HAS_WARP = importlib.util.find_spec("warp") is not None
WARP = pytest.param(
    "warp",
    marks=pytest.mark.skipif(
        not HAS_WARP, reason="NVIDIA Warp is not installed: pip install 'cref-jax[warp]'"
    ),
)
ON_DEVICE = ["mjx", WARP]  # the engines for an accelerator; they run on a CPU as well
# Warp's line search takes other steps: where Newton's last iteration is not enough, the two part
CONVERGED = dataclasses.replace(ONE_SUBSTEP, iterations=50, line_search=50)
AGAINST_C = pytest.mark.parametrize(
    ("engine", "reference"),
    [
        pytest.param("mjx", "mujoco", id="mjx"),
        pytest.param("warp, converged", "mujoco, converged", id="warp", marks=WARP.marks),
    ],
)


class Run(NamedTuple):
    """What a simulation has come to."""

    qpos: np.ndarray  # [N, Q]
    qvel: np.ndarray  # [N, V]
    force: np.ndarray  # N, on all spheres [N, 3]


# Lanes of every height for the first robot; the others share its code, and differ as data alone
LANES = [(None, where) for where in AT] + [(name, "stairs") for name in list(robot.ROBOTS)[1:]]


@pytest.fixture(scope="module")
def name(request) -> str | None:
    """Return the robot that a test asks for by an indirect parameter, or None: the first."""
    return getattr(request, "param", None)


@pytest.fixture(scope="module")
def physics(name):
    settings = {"mujoco": ONE_SUBSTEP, "mujoco, converged": CONVERGED, "mjx": ONE_SUBSTEP}
    if HAS_WARP:
        settings |= {"warp": ONE_SUBSTEP, "warp, converged": CONVERGED}
    make = lambda engine, c: Physics(config.Robot(name), c, engine.split(",")[0], threads=2)
    return {engine: make(engine, c) for engine, c in settings.items()}


@pytest.fixture(scope="module")
def x2(physics) -> robot.Robot:
    return physics["mujoco"].robot


@pytest.fixture(scope="module")
def ground():
    profile = np.concatenate([np.full(round(length / CELL), z) for length, z in LANE])
    return terrain.from_heights(profile[:, None], CELL, (0.0, 0.0))  # its border goes on across


@pytest.fixture(scope="module")
def substep(physics, ground):
    """Return engine -> (body, dynamics, target) -> body and force on the feet.

    The motors hold the nominal pose, or each robot's target.
    """

    def make(p):
        once = lambda body, dynamics, target: p.step(
            ground, body, jnp.stack([target, target]), jnp.int32(0), dynamics
        )
        every, rest = jax.jit(jax.vmap(once)), jnp.tile(p.robot.nominal_pose, (ROBOTS, 1))
        return lambda body, dynamics, target=rest: every(body, dynamics, target)

    return {engine: make(p) for engine, p in physics.items()}


@pytest.fixture(scope="module")
def centres(physics):
    """Return (qpos) -> centres of the contact spheres [N, S, 3]."""
    p = physics["mujoco"]

    def find(qpos):
        links = p.links(Body(qpos, jnp.zeros(p.model.nv), jnp.zeros(p.model.nv)))
        return kinematics.points(links, p.robot.spheres.body, p.robot.spheres.position)

    return jax.jit(jax.vmap(find))


@pytest.fixture(scope="module")
def put_down(x2, ground, centres):
    """Return (qpos, depth) -> qpos moved vertically until a sphere is `depth` in the ground."""
    near = jax.vmap(jax.vmap(lambda p: terrain.closest_point(ground, p)[2]))
    reach = jax.jit(lambda points: (near(points) - x2.spheres.radius).min(axis=1))

    def move(qpos, depth):
        points = centres(jnp.asarray(qpos, jnp.float32))
        low, high = np.full(len(qpos), -2.0), np.full(len(qpos), 3.0)
        for _ in range(20):
            middle = 0.5 * (low + high)
            free = np.asarray(reach(points + jnp.array([0.0, 0.0, 1.0]) * middle[:, None, None]))
            low, high = np.where(free > -depth, [low, middle], [middle, high])
        return qpos + np.eye(qpos.shape[1])[2] * high[:, None]

    return move


def poses(x2, places, rng, spread=0.0, tilt=0.0, yaw=0.0):
    """Return robots at `places` x, the joints `spread` off the nominal pose, at z = 0.

    The joints that are held are off by a tenth of that: their motors saturate soon.
    """
    qpos = np.zeros((len(places), 7 + len(x2.rest_pose)))
    qpos[:, 0] = places
    spread = np.where(np.arange(len(x2.rest_pose)) < len(x2.nominal_pose), spread, 0.1 * spread)
    qpos[:, 7:] = x2.rest_pose + rng.uniform(-spread, spread, (len(places), len(x2.rest_pose)))
    axis = rng.normal(size=(len(places), 3))
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    lean = geometry.quat_from_axis_angle(
        jnp.asarray(axis, jnp.float32), jnp.asarray(rng.uniform(0.0, tilt, len(places)))
    )
    turn = geometry.quat_from_axis_angle(
        jnp.array([0.0, 0.0, 1.0]), jnp.asarray(rng.uniform(-yaw, yaw, len(places)))
    )
    qpos[:, 3:7] = geometry.quat_multiply(turn, lean)
    return qpos


def body_of(qpos, qvel=None) -> Body:
    still = jnp.zeros((len(qpos), qpos.shape[1] - 1))
    qvel = still if qvel is None else jnp.asarray(qvel, jnp.float32)
    return Body(jnp.asarray(qpos, jnp.float32), qvel, still)


def nominal(physics) -> Dynamics:
    each = physics["mujoco"].nominal_dynamics()
    return jax.tree.map(lambda x: jnp.tile(x, (ROBOTS,) + (1,) * x.ndim), each)


def varied(physics, rng) -> Dynamics:
    """Return dynamics at least as varied as those that training draws."""
    each, draw = nominal(physics), lambda *shape: rng.uniform(-1.0, 1.0, shape)
    joints = each.kp.shape[1]
    changed = Dynamics(
        friction=0.8 + 0.5 * draw(ROBOTS),
        payload=3.0 * draw(ROBOTS),
        com_shift=0.06 * draw(ROBOTS, 3),
        kp=np.asarray(each.kp) * (1.0 + 0.2 * draw(ROBOTS, joints)),
        kd=np.asarray(each.kd) * (1.0 + 0.2 * draw(ROBOTS, joints)),
    )
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), changed)


# The engines for an accelerator against MuJoCo C


@pytest.mark.slow
@AGAINST_C
@pytest.mark.parametrize(("name", "where"), LANES, indirect=["name"])
def test_one_substep_is_the_same_as_in_mujoco_c(
    physics, x2, substep, put_down, where, engine, reference
):
    rng = np.random.default_rng(0)
    qpos = poses(x2, rng.uniform(*AT[where], ROBOTS), rng, spread=0.3, tilt=0.3, yaw=0.5)
    depth = rng.uniform(-0.002, 0.006, ROBOTS)
    is_held = np.arange(physics["mujoco"].model.nv) >= 6 + len(x2.nominal_pose)
    qvel = np.where(is_held, 0.1, 0.5) * rng.normal(size=(ROBOTS, len(is_held)))
    body, dynamics = body_of(put_down(qpos, depth), qvel), varied(physics, rng)
    ours, force = substep[engine](body, dynamics)
    theirs, expected = substep[reference](body, dynamics)
    assert (np.linalg.norm(expected, axis=-1) > 0.0).any(axis=1).mean() > 0.5
    assert np.abs(ours.qvel - theirs.qvel).max() <= 2e-3
    assert np.abs(force - expected).max() <= 0.1


@pytest.mark.slow
@AGAINST_C
@pytest.mark.parametrize("height", [1.0, -0.01], ids=["in the air", "on the ground"])
def test_motors_at_their_limit_are_the_same_as_in_mujoco_c(
    physics, x2, substep, height, engine, reference
):
    # an engine that damps such motors is off by 7 to 9 rad/s in half of these robots
    rng, driven = np.random.default_rng(0), len(x2.nominal_pose)
    qpos = poses(x2, rng.uniform(*AT["flat"], ROBOTS), rng, spread=0.3, tilt=0.3, yaw=0.5)
    qpos[:, 2] = x2.standing_height + height
    pace = np.where(np.arange(physics["mujoco"].model.nv) < 6, 0.5, 2.0)  # m/s, rad/s
    qvel = pace * rng.normal(size=(ROBOTS, len(pace)))
    target = x2.nominal_pose + rng.uniform(-1.5, 1.5, (ROBOTS, driven))
    body, dynamics = body_of(qpos, qvel), varied(physics, rng)
    error = target - qpos[:, 7 : 7 + driven]
    torque = dynamics.kp * error - dynamics.kd * qvel[:, 6 : 6 + driven]
    saturated = np.abs(torque) >= x2.effort
    assert 0.2 < saturated.mean() < 0.4 and saturated.any(axis=1).mean() > 0.95
    target = jnp.asarray(target, jnp.float32)
    ours, force = substep[engine](body, dynamics, target)
    theirs, expected = substep[reference](body, dynamics, target)
    off = np.abs(ours.qvel - theirs.qvel).max(axis=1)
    # on the ground six iterations are not always enough
    all_converge = height > 0.0 or "converged" in reference
    assert (off <= 5e-4).all() if all_converge else np.quantile(off, 0.98) <= 5e-4
    assert np.abs(force - expected).max() <= 0.5


def test_only_a_motor_at_its_limit_becomes_a_constant_torque(physics, x2):
    p, nominal_dynamics = physics["mjx"], physics["mjx"].nominal_dynamics()
    qpos = jnp.concatenate([jnp.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]), x2.rest_pose])
    np.testing.assert_array_equal(x2.kp[:4], [100.0, 100.0, 100.0, 150.0])  # N m / rad
    np.testing.assert_array_equal(x2.kd[:4], [4.0, 3.0, 3.0, 5.0])  # N m s / rad
    np.testing.assert_array_equal(x2.effort[:4], 120.0)  # N m
    # 100 x 1.1 = 110; 100 x 1.3 = 130, too much; 130 - 3 x 5 = 115; 150 x -1 = -150, too much
    target = jnp.asarray(x2.rest_pose).at[:4].add(jnp.array([1.1, 1.3, 1.3, -1.0]))
    qvel = jnp.zeros(p.model.nv).at[6 + 2].set(5.0)
    found = p.engine.model(qpos, qvel, target, nominal_dynamics)
    gain, bias = p.model.actuator_gainprm.copy(), p.model.actuator_biasprm.copy()
    gain[[1, 3]], bias[[1, 3]] = 0.0, 0.0
    bias[[1, 3], 0] = 120.0, -120.0
    np.testing.assert_array_equal(found.actuator_gainprm, gain.astype(np.float32))
    np.testing.assert_array_equal(found.actuator_biasprm, bias.astype(np.float32))


def held(substep, start: Body, dynamics: Dynamics, seconds: float) -> Run:
    """Let robots sink onto the ground, with all of the pelvis but its height held."""
    body, height = start, jnp.eye(7)[2]
    for _ in range(round(seconds / TIMESTEP)):
        body, force = substep(body, dynamics)
        free = jnp.where(height == 1.0, body.qpos[:, :7], start.qpos[:, :7])
        qpos = body.qpos.at[:, :7].set(free)
        body = Body(qpos, body.qvel.at[:, :6].multiply(height[:6]), body.warmstart)
    return Run(*(np.asarray(x) for x in (body.qpos, body.qvel, force.sum(axis=1))))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", *ON_DEVICE])
def test_the_feet_of_a_standing_robot_bear_its_weight(physics, x2, substep, put_down, engine):
    places = np.full(ROBOTS, 1.0)
    start = body_of(put_down(poses(x2, places, np.random.default_rng(0), yaw=3.0), 0.0))
    dynamics = nominal(physics)._replace(payload=jnp.linspace(-2.5, 2.5, ROBOTS))
    found = held(substep[engine], start, dynamics, seconds=1.0)
    assert np.abs(found.qvel[:, 2]).max() < 0.005
    weight = (x2.mass + np.asarray(dynamics.payload)) * GRAVITY
    np.testing.assert_allclose(found.force[:, 2], weight, rtol=0.02)


# Tangent planes against boxes


@pytest.fixture(scope="module")
def boxes(x2) -> mujoco.MjModel:
    """The same robot on boxes instead of planes, one a stretch of the lane."""
    spec = robot.spec(robot.moving(config.Robot()), ONE_SUBSTEP, contact_planes=0)
    touching = {"condim": 3, "friction": [robot.FRICTION, 0.005, 0.0001]}
    for geom in spec.geoms:
        for name, value in {"contype": 1, "conaffinity": 2, **touching}.items():
            setattr(geom, name, value)
    end = np.cumsum([length for length, _ in LANE])
    for (length, z), x in zip(LANE, end, strict=True):
        low = x - length if x > LANE[0][0] else -5.0  # the ends of the lane go on
        high = x if x < end[-1] else x + 5.0
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[0.5 * (low + high), 0.0, 0.5 * (z - 3.0)],
            size=[0.5 * (high - low), 5.0, 0.5 * (z + 3.0)],
            contype=2,
            conaffinity=1,
            **touching,
        )
    return spec.compile()


def on_boxes(model, x2, start, base_of) -> Run:
    """Return where one robot ends on boxes; `base_of` changes its state before each substep."""
    state = mujoco.MjData(model)
    state.qpos, state.ctrl = start, x2.rest_pose
    for base in base_of:
        base(state.qpos, state.qvel)
        mujoco.mj_step(model, state)
    return Run(state.qpos.copy(), state.qvel.copy(), state.qfrc_constraint[:3].copy())


@pytest.mark.slow
def test_a_robot_rests_as_it_does_on_boxes(physics, x2, substep, put_down, boxes):
    rng, seconds = np.random.default_rng(0), 3.0
    places = np.concatenate([rng.uniform(*span, ROBOTS // len(AT)) for span in AT.values()])
    start = put_down(poses(x2, places, rng, yaw=0.5), -0.002)
    found = held(substep["mujoco"], body_of(start), nominal(physics), seconds)

    def alone(qpos: np.ndarray) -> Run:
        def hold(q, v):
            q[[0, 1, 3, 4, 5, 6]], v[[0, 1, 3, 4, 5]] = qpos[[0, 1, 3, 4, 5, 6]], 0.0

        return on_boxes(boxes, x2, qpos, [hold] * round(seconds / TIMESTEP))

    expected = Run(*(np.stack(x) for x in zip(*map(alone, start), strict=True)))
    resting = np.abs(expected.qvel[:, 6:]).max(axis=1) < 0.05
    assert resting.sum() > 0.9 * ROBOTS
    assert np.abs(found.qpos[:, 2] - expected.qpos[:, 2])[resting].max() < 5e-4
    np.testing.assert_allclose(found.force[resting], expected.force[resting], rtol=0.01, atol=3.0)
    # some lean so hard on the hold of the pelvis that it bears a part of them, on boxes as well
    weight = x2.mass * GRAVITY
    free = resting & (np.abs(expected.force[:, 2] / weight - 1.0) < 0.01)
    assert free.sum() > 0.9 * ROBOTS
    np.testing.assert_allclose(found.force[free, 2], weight, rtol=0.02)
    # many stand on two levels, or with a part of a foot over an edge
    assert (start[:, 2] - expected.qpos[:, 2] > 0.03)[free].sum() > 30


def way(x2, centres):
    """Return the base's (x, z, vx, vz) over time [T, N, 4]: to the riser, wait, up, and on.

    The soles start between 2 cm below the ground, so that the legs bear a load, and 5 cm above it;
    at the riser the legs have to give way by 2 to 8 cm.
    """
    rng = np.random.default_rng(0)
    toe = np.asarray(centres(jnp.asarray(poses(x2, [0.0], rng), jnp.float32)))[0, :, 0].max() + 0.01
    x = RISER - toe - 0.1 * np.ones(ROBOTS)
    z = x2.standing_height + rng.uniform(-0.02, 0.05, ROBOTS)
    press = 0.1 + rng.uniform(0.02, 0.08, ROBOTS)
    phases = [  # s, m/s, m/s
        (1.0, press, 0.0),
        (0.3, 0.0, 0.0),
        (0.7, 0.0, 1.0),  # over the highest step
        (0.5, 0.6, 0.0),
    ]
    rows = []
    for seconds, vx, vz in phases:
        for _ in range(round(seconds / TIMESTEP)):
            rows.append(np.stack([x, z, vx + 0.0 * x, vz + 0.0 * x], axis=1))
            x, z = x + vx * TIMESTEP, z + vz * TIMESTEP
    return np.stack(rows), round(1.3 / TIMESTEP)


def base_at(row):
    """Return qpos and qvel of a level base at (x, z, vx, vz)."""
    x, z, vx, vz = row
    return [x, 0.0, z, 1.0, 0.0, 0.0, 0.0], [vx, 0.0, vz, 0.0, 0.0, 0.0]


def set_base(row, qpos, qvel):
    qpos[:7], qvel[:6] = base_at(row)


@pytest.mark.slow
def test_a_riser_stops_a_foot_until_it_is_above(physics, x2, substep, centres, boxes):
    rows, pressed = way(x2, centres)
    start = poses(x2, rows[0, :, 0], np.random.default_rng(0))
    body, dynamics = body_of(start), nominal(physics)
    bases = jax.jit(jax.vmap(jax.vmap(lambda r: tuple(map(jnp.stack, base_at(r))))))(rows)
    hovers = rows[0, :, 1] > x2.standing_height + 0.005
    front = np.full(ROBOTS, -np.inf)
    for k, (qpos, qvel) in enumerate(zip(*bases, strict=True)):
        body = body._replace(qpos=body.qpos.at[:, :7].set(qpos), qvel=body.qvel.at[:, :6].set(qvel))
        body, force = substep["mujoco"](body, dynamics)
        centre = np.asarray(centres(body.qpos))
        ahead = np.where(centre[:, :, 2] < 0.148, centre[:, :, 0] + x2.spheres.radius, -np.inf)
        front = np.maximum(front, ahead.max(axis=1))
        if k == pressed:
            at_riser, push = np.asarray(body.qpos), np.asarray(force.sum(axis=1))
    assert front[hovers].min() > RISER - 0.001 and front[hovers].max() < RISER + 0.004
    assert front.max() < RISER + 0.006  # in the corner of tread and riser, one plane has to do
    assert (push[hovers, 0] < -40.0).mean() > 0.95  # N, back on the feet
    toes = centre[:, x2.spheres.foot >= 0, 0].max(axis=1)
    assert (toes > RISER + 0.3).all() and not force.any()

    for i in range(0, ROBOTS, 10):
        bases = [partial(set_base, row) for row in rows[: pressed + 1, i]]
        expected = on_boxes(boxes, x2, start[i], bases)
        far = 1e-3 if hovers[i] else 0.05  # rad
        np.testing.assert_allclose(at_riser[i, 7:], expected.qpos[7:], atol=far)
        if hovers[i]:
            np.testing.assert_allclose(push[i], expected.force, rtol=0.02, atol=1.0)


@pytest.mark.slow
def test_a_riser_throws_a_fast_foot_back_as_boxes_do(physics, x2, substep, centres, boxes):
    # at 8 m/s a toe is 4 cm within the riser before the first force acts
    rng = np.random.default_rng(0)
    start = poses(x2, np.zeros(ROBOTS), rng)
    toe = np.asarray(centres(jnp.asarray(start, jnp.float32)))[0, :, 0].max() + 0.01
    start[:, 0] = RISER - toe - rng.uniform(0.0, 0.03, ROBOTS)
    start[:, 2] = x2.standing_height + rng.uniform(0.02, 0.08, ROBOTS)
    qvel = rng.uniform(3.0, 8.0, (ROBOTS, 1)) * np.eye(physics["mujoco"].model.nv)[0]
    body, dynamics, deepest = body_of(start, qvel), nominal(physics), -np.inf
    for _ in range(10):
        body, _ = substep["mujoco"](body, dynamics)
        deepest = np.maximum(deepest, np.asarray(centres(body.qpos))[:, :, 0].max(axis=1) - RISER)
    assert (deepest > 0.02).mean() > 0.5
    for i in range(0, ROBOTS, 10):
        state = mujoco.MjData(boxes)
        state.qpos, state.qvel, state.ctrl = start[i], qvel[i], x2.rest_pose
        mujoco.mj_step(boxes, state, nstep=10)
        np.testing.assert_allclose(body.qpos[i], state.qpos, atol=1e-3)


def test_an_engine_that_is_asked_for_is_taken():
    names = ["mujoco", "mjx", "warp"]
    assert [resolve_engine(name) for name in names] == names


@pytest.mark.parametrize(
    ("backend", "devices", "warp", "engine"),
    [
        ("cpu", 2, True, "mujoco"),
        ("gpu", 1, True, "warp"),
        ("gpu", 1, False, "mjx"),
        ("gpu", 8, True, "mjx"),
    ],
)
def test_the_engine_is_chosen_by_the_device(monkeypatch, backend, devices, warp, engine):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(jax, "device_count", lambda: devices)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: warp or None)
    assert resolve_engine("auto") == engine


@pytest.mark.slow
@pytest.mark.parametrize("engine", ON_DEVICE)
def test_a_state_that_is_not_finite_harms_no_other(physics, x2, substep, put_down, engine):
    start = body_of(put_down(poses(x2, np.full(ROBOTS, 1.0), np.random.default_rng(0)), 0.002))
    sound, _ = substep[engine](start, nominal(physics))
    broken = start._replace(qpos=start.qpos.at[2, 9].set(jnp.nan))
    found, _ = substep[engine](broken, nominal(physics))
    assert np.isnan(found.qvel[2]).all()
    np.testing.assert_array_equal(np.delete(found.qvel, 2, 0), np.delete(sound.qvel, 2, 0))


@pytest.mark.slow
@pytest.mark.parametrize("engine", [WARP])
def test_batches_of_batches_have_room_for_every_contact(physics, x2, put_down, engine):
    # one robot bears on the ground with eight spheres, and so do the other 199
    p = physics[engine]
    body = body_of(put_down(poses(x2, np.full(ROBOTS, 1.0), np.random.default_rng(0)), 0.004))
    flat = terrain.from_heights(jnp.zeros((1, 1)), CELL)

    def force(body: Body) -> np.ndarray:
        planes, rest = p.planes(flat, body), jnp.asarray(x2.rest_pose)
        return p.engine.substep(SubstepInput(*body, rest, *planes, p.nominal_dynamics())).force

    halves = jax.tree.map(lambda x: x.reshape(2, ROBOTS // 2, -1), body)
    found = np.asarray(jax.jit(jax.vmap(jax.vmap(force)))(halves)).reshape(ROBOTS, 2, 3)
    assert (found[:, :, 2] > 100.0).all()  # N
    np.testing.assert_allclose(found, np.broadcast_to(found[:1], found.shape), atol=0.1)


def test_an_engine_that_is_not_installed_is_one_line(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        errors.ConfigError, match=r"'warp' needs .*: pip install 'cref-jax\[warp\]'"
    ):
        Physics(config.Robot(), ONE_SUBSTEP, "warp")


# The engine for a CPU


def test_a_robot_alone_is_the_same_as_in_a_batch_bit_for_bit(physics, x2):
    rng, p = np.random.default_rng(0), physics["mujoco"]
    qpos = poses(x2, np.full(ROBOTS, 1.0), rng, spread=0.3, tilt=0.3)
    qpos[:, 2] = x2.standing_height - 0.01
    body, dynamics = body_of(qpos, rng.normal(size=(ROBOTS, p.model.nv))), varied(physics, rng)
    flat = terrain.from_heights(jnp.zeros((1, 1)), CELL)
    planes = jax.jit(jax.vmap(lambda b: p.planes(flat, b)))(body)
    target = jnp.tile(x2.rest_pose, (ROBOTS, 1))
    inputs = SubstepInput(*body, target, *planes, dynamics)
    batch = jax.vmap(p.engine.substep)(inputs)
    for i in (0, 7, 199):
        alone = p.engine.substep(jax.tree.map(lambda x, i=i: x[i], inputs))
        jax.tree.map(
            lambda a, b, i=i: np.testing.assert_array_equal(a, b[i]), tuple(alone), tuple(batch)
        )


def test_callers_at_the_same_time_do_not_mix_their_robots(physics, x2, substep):
    dynamics, start = nominal(physics), []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        qpos = poses(x2, np.full(ROBOTS, 1.0), rng, spread=0.3, tilt=0.3)
        qpos[:, 2] = x2.standing_height
        start.append(body_of(qpos))

    def run(body: Body) -> np.ndarray:
        for _ in range(30):
            body, _ = substep["mujoco"](body, dynamics)
        return np.asarray(body.qpos)

    in_turn = [run(body) for body in start]
    with ThreadPoolExecutor(4) as pool:
        np.testing.assert_array_equal(list(pool.map(run, start)), in_turn)


def test_a_state_that_is_not_finite_comes_back_as_nan_and_harms_no_other(physics, x2):
    p, count = physics["mujoco"], 4
    qpos = poses(x2, np.full(count, 1.0), np.random.default_rng(0))
    qpos[:, 2] = x2.standing_height
    flat = terrain.from_heights(jnp.zeros((1, 1)), CELL)
    planes = jax.jit(jax.vmap(lambda b: p.planes(flat, b)))(body_of(qpos))
    rest = jax.tree.map(
        lambda x: jnp.stack([x] * count), (jnp.asarray(x2.rest_pose), p.nominal_dynamics())
    )
    once = lambda body: jax.vmap(p.engine.substep)(SubstepInput(*body, rest[0], *planes, rest[1]))
    sound = once(body_of(qpos))
    for part, where in (("qpos", 9), ("qvel", 3), ("warmstart", 0)):
        body = body_of(qpos)
        body = body._replace(**{part: getattr(body, part).at[2, where].set(jnp.inf)})
        found = once(body)
        for ours, expected in zip(found, sound, strict=True):
            assert np.isnan(np.asarray(ours[2])).all()
            np.testing.assert_array_equal(np.delete(ours, 2, 0), np.delete(expected, 2, 0))
