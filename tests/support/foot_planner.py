"""A slow walker on a scene's real geometry: it shows that a scene can be passed on foot.

Footholds are planned on rays that are cast down. Then two feet with the contacts of the robot's
own go there in MuJoCo C, and each in turn carries the robot's whole weight. At last the robot's
upper body is led along the way, in its nominal pose, and must meet nothing.
"""

import itertools
from typing import NamedTuple

import mujoco
import numpy as np

from cref_jax import config, robot
from cref_jax.config import Config
from cref_jax.whole_body.simulator import WholeBodySim

X2 = robot.load(config.Robot(actuated="all"))
START = 0.75  # m
GRID = 0.01  # m, between rays along x
SOLE_X, SOLE_Y = (-0.06, 0.13), (-0.05, 0.05)  # m, of the sole in the frame of the ankle
ANKLE = 0.0734  # m, from the sole up
FOOT_Y = {"left": 0.137, "right": -0.137}  # m, at the nominal pose
STEP = (0.05, 0.45)  # m along x
RISE = 0.25  # m, at most
LEVEL = 0.012  # m, within which a ray shows ground that bears
SLOPES = np.tan(np.radians([0, -3, 3, -6, 6, -9, 9, -12, 12]))
SINK = 0.02  # m
TILT = 8.0  # deg
SWAY = (-0.05, 0.0, 0.05)  # m, of the upper body to the sides
LEGS = ("hip", "knee", "ankle")


class Impassable(AssertionError):
    """The scene cannot be passed; the message says where and why."""


class Foothold(NamedTuple):
    side: str
    x: float  # m, of the ankle
    z: float  # m, of the ground under it
    slope: float  # m/m


def walk(ground) -> list[Foothold]:
    """Return the footholds of a walk through the scene.

    Raises:
        Impassable: there is none.
    """
    steps = plan(ground)
    tread(ground, steps)
    lead(ground, steps)
    return steps


def plan(ground) -> list[Foothold]:
    """Return footholds from the start to the end, the cheapest by length and support."""
    heights = {side: rays_down(ground, y) for side, y in FOOT_Y.items()}
    holds = {side: footholds(h) for side, h in heights.items()}
    count = len(holds["left"][0])
    other = {"left": "right", "right": "left"}
    cost = {side: np.full(count, np.inf) for side in FOOT_Y}
    came = {side: np.full(count, -1) for side in FOOT_Y}
    cost["left"][0] = 0.0
    near, far = (round(step / GRID) for step in STEP)
    reached = 0
    for i in range(count):
        for side in FOOT_Y:
            if not np.isfinite(cost[side][i]):
                continue
            reached = max(reached, i)
            z, share, _ = holds[other[side]]
            for j in range(i + near, min(i + far + 1, count)):
                rise = abs(z[j] - holds[side][0][i])
                if share[j] > 0.0 and rise <= RISE:
                    found = cost[side][i] + abs(GRID * (j - i) - 0.3) + (1 - share[j]) + rise
                    if found < cost[other[side]][j]:
                        cost[other[side]][j], came[other[side]][j] = found, i
    side = min(FOOT_Y, key=lambda s: cost[s][-far:].min())
    i = count - far + int(cost[side][-far:].argmin())
    if not np.isfinite(cost[side][i]):
        raise Impassable(f"no foothold after x = {START + GRID * reached:.2f} m")
    steps = []
    while i >= 0:
        z, _, slope = holds[side]
        steps.append(Foothold(side, START + GRID * i, float(z[i]), float(slope[i])))
        i, side = came[side][i], other[side]
    return steps[::-1]


def rays_down(ground, y: float) -> np.ndarray:
    """Return the heights under a foot's path, [X, Y], m, from a sole before START on."""
    spec = mujoco.MjSpec()
    ground.add_to(spec, robot.FRICTION)
    model = spec.compile()
    state, found = mujoco.MjData(model), np.zeros(1, np.int32)
    mujoco.mj_forward(model, state)
    x = np.arange(START - 0.1, ground.end + 0.5, GRID)
    across = y + np.linspace(*SOLE_Y, 8)
    down, top = np.array([0.0, 0.0, -1.0]), 3.0
    cast = lambda a, b: (
        top - mujoco.mj_ray(model, state, np.array([a, b, top]), down, None, True, -1, found)
    )
    return np.array([[cast(a, b) for b in across] for a in x])


def footholds(heights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for each x from START on: height, m, the share that bears (0: none), and slope."""
    before, after = round(SOLE_X[0] / GRID), round(SOLE_X[1] / GRID)
    y = np.linspace(*SOLE_Y, heights.shape[1])
    along = np.arange(before - 2, after + 3)  # 2 cm more, which nothing may stand in
    x = GRID * along[:, None]
    sole = (along >= before) & (along <= after)
    first = round(0.1 / GRID)
    best = []
    for i in range(first, len(heights) - after - 3):
        options = []
        for slope in SLOPES:
            left = heights[i + along] - slope * x
            z = left[sole].max()
            bears = (left > z - LEVEL) & sole[:, None]
            around = all(
                (bears & (u * x > 0.015) & (v * y > 0.015)).any() for u in (-1, 1) for v in (-1, 1)
            )
            clear = left.max() <= z + 0.01
            share = bears.sum() / (sole.sum() * len(y))
            options.append((share if around and clear else 0.0, z, slope))
        best.append(max(options, key=lambda o: o[0]))
    share, z, slope = np.array(best).T
    return z, share, slope


def tread(ground, steps: list[Foothold]) -> None:
    """Let the feet go there, each with the whole weight on it in turn."""
    model = feet_on(ground)
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    at = {side: np.array([START, y, ANKLE + 0.005]) for side, y in FOOT_Y.items()}
    number = {"left": 0, "right": 1}
    for step in steps:
        k, start = number[step.side], at[step.side]
        goal = np.array([step.x, FOOT_Y[step.side], step.z + ANKLE + 0.01])
        high = max(start[2], goal[2], *(h.z + ANKLE for h in steps if start[0] < h.x < step.x))
        above = lambda point, z=high + 0.1: np.array([*point[:2], z])
        over = [above(start), above(goal), goal]
        state.eq_active[k] = 1
        pitch = -np.arctan(step.slope)
        state.mocap_quat[k] = [np.cos(pitch / 2), 0.0, np.sin(pitch / 2), 0.0]
        for a, b in zip([start, *over], over, strict=False):
            for share in np.linspace(0.0, 1.0, 40):
                state.mocap_pos[k] = a + share * (b - a)
                mujoco.mj_step(model, state)
        state.eq_active[k] = 0
        for _ in range(80):  # 0.4 s
            mujoco.mj_step(model, state)
        foot = state.body(step.side)
        sunk = step.z + ANKLE - foot.xpos[2]
        normal = np.array([-step.slope, 0.0, 1.0]) / np.hypot(1.0, step.slope)
        tilt = np.degrees(np.arccos(np.clip(foot.xmat.reshape(3, 3)[:, 2] @ normal, -1, 1)))
        missed = float(np.linalg.norm(foot.xpos[:2] - goal[:2]))
        if abs(sunk) > SINK or tilt > TILT or missed > 0.05:
            raise Impassable(
                f"{step}: sinks {sunk:.3f} m, tilts {tilt:.1f} deg, is {missed:.3f} m off"
            )
        at[step.side] = foot.xpos.copy()


def feet_on(ground) -> mujoco.MjModel:
    """Return the scene with two feet, each as heavy as the robot, that a mocap body can hold."""
    spec = mujoco.MjSpec()
    ground.add_to(spec, robot.FRICTION)
    spec.option.timestep = 0.005
    whole = robot.spec("all", config.Physics(), contact_planes=0, visual=True)
    for side, y in FOOT_Y.items():
        spec.worldbody.add_body(name=f"hand_{side}", mocap=True, pos=[START, y, ANKLE])
        foot = spec.worldbody.add_body(name=side, pos=[START, y, ANKLE])
        foot.add_freejoint()
        foot.mass, foot.inertia, foot.ipos = X2.mass, [0.3, 0.3, 0.3], [0.0, 0.0, 0.0]
        foot.explicitinertial = True
        for geom in whole.body(f"{side}_ankle_roll_link").geoms:
            if geom.name:  # the others are only there to be seen
                shape = {
                    key: getattr(geom, key) for key in ("type", "size", "pos", "quat", "fromto")
                }
                foot.add_geom(**shape, contype=1, conaffinity=0, friction=[0.9, 0.005, 0.0001])
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=f"hand_{side}",
            name2=side,
            active=True,
            data=[0.0] * 10
            + [1.0, 0.0],  # the pose between the two as at the start; turned as well
        )
    return spec.compile()


def lead(ground, steps: list[Foothold]) -> None:
    """Lead the upper body over the feet."""
    body = WholeBodySim(Config(), ground, X2.joint_names)
    state = mujoco.MjData(body.model)
    state.qpos[3], state.qpos[7:] = 1.0, X2.nominal_pose
    links = [body.model.body(b).name for b in body.model.geom_bodyid]
    upper = {
        geom
        for geom, link in enumerate(links)
        if link != "world" and not any(leg in link for leg in LEGS)
    }
    x = [0.5 * (a.x + b.x) for a, b in itertools.pairwise(steps)]
    z = [0.5 * (a.z + b.z) for a, b in itertools.pairwise(steps)]
    for at in np.arange(x[0], x[-1], 0.02):
        for sway in SWAY:
            state.qpos[:3] = at, sway, X2.standing_height + np.interp(at, x, z)
            mujoco.mj_forward(body.model, state)
            met = [contact for contact in state.contact if not upper.isdisjoint(contact.geom)]
            if met:
                name = next(body.model.geom(g).name for g in met[0].geom if g in upper)
                raise Impassable(f"{name} meets something at x = {at:.2f} m, {sway:+.2f} m aside")
