import dataclasses

import foot_planner
import mujoco
import numpy as np
import pytest
from tiny_policy import ROBOT

from cref_jax import config, deploy, robot
from cref_jax.config import Config
from cref_jax.deploy import Status
from cref_jax.errors import ConfigError
from cref_jax.evaluation import protocol
from cref_jax.terrain import lanes
from cref_jax.whole_body import scene_files, termination
from cref_jax.whole_body.disturbances import Channel, Disturbance
from cref_jax.whole_body.simulator import WholeBodySim
from cref_jax.whole_body.trial import Start, _initial_state, run_trial

C = protocol.evaluation_config(Config())
SCENES = scene_files.load_all()
HEAD = 'title = "a scene"\nend = 6.0\nwidth = 1.4\n'
STANDING = Start(
    np.array([0.7, 0.0, ROBOT.standing_height, 1.0, 0.0, 0.0, 0.0]), ROBOT.nominal_pose, 0.5
)


class Standing(deploy.Policy):
    """A policy that holds the nominal pose and remembers which frames it was shown."""

    def __init__(self):
        self.blind, self.status = False, Status.OK

    def reset(self):
        self.frames, self.came = [], []

    def on_depth(self, image, stamp):
        self.frames.append((image, stamp))
        return Status.OK

    def step(self, angular_velocity, gravity, command, q, qd, now):
        self.came += [now] * (len(self.frames) - len(self.came))
        return ROBOT.nominal_pose.astype(float)


@pytest.fixture
def scene(tmp_path):
    """Return what reads a scene from text."""

    def read(text, head=HEAD):
        path = tmp_path / "mine.toml"
        path.write_text(head + text)
        return scene_files.load(path)

    return read


def on(ground, friction=robot.FRICTION):
    return WholeBodySim(C, ground, ROBOT.joint_names, friction)


def placed(body, **changes):
    """Return the state with the base's x, y or z changed."""
    base = np.array(STANDING.base)
    for name, value in changes.items():
        base["xyz".index(name)] = value
    return _initial_state(body, STANDING._replace(base=base))


def down(ground, x, y, z=1.0):
    """Return how far a ray goes straight down from a point, m."""
    spec = mujoco.MjSpec()
    ground.add_to(spec, 0.9)
    model = spec.compile()
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    found = np.zeros(1, np.int32)
    return mujoco.mj_ray(
        model, state, np.array([x, y, z]), np.array([0.0, 0.0, -1.0]), None, True, -1, found
    )


def test_there_are_twenty_scenes_each_of_its_own_title_and_with_its_source():
    assert len(SCENES) == 20
    assert len({s.title for s in SCENES.values()}) == 20
    for name in SCENES:
        text = (scene_files.directory() / f"{name}.toml").read_text(encoding="utf-8")
        head = [line for line in text.splitlines()[:3] if line.startswith("#")]
        assert len(head) >= 2 and "assumed" in " ".join(head), name


def test_every_look_has_a_colour():
    used = {solid.look for s in SCENES.values() for solid in s.solids}
    assert used <= set(scene_files.COLOURS) == set(scene_files.Look.__args__)


@pytest.mark.parametrize("name", SCENES)
def test_the_start_is_level_and_free(name):
    ground = SCENES[name]
    assert ground.end < 9.0  # 0.4 m/s come there in 21 s
    assert not any(a < 1.5 for a, _ in ground.ditches)
    for solid in ground.solids:
        turned = np.zeros(9)
        mujoco.mju_quat2Mat(turned, solid.rotation)
        a, b, c = solid.size
        half = np.abs(turned.reshape(3, 3)) @ ([a, b, c] if solid.kind == "box" else [a, a, b])
        assert solid.middle[0] - half[0] >= 1.5 or abs(solid.middle[1]) - half[1] > 0.6, solid


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_can_be_passed_on_foot(name):
    assert foot_planner.walk(SCENES[name])[-1].x > SCENES[name].end - 0.45


def test_a_ditch_that_is_too_wide_cannot_be_passed_on_foot(scene):
    with pytest.raises(foot_planner.Impassable, match="no foothold"):
        foot_planner.walk(scene("ditches = [[2.5, 3.5]]\n"))


def test_a_rail_across_the_path_cannot_be_passed_on_foot(scene):
    rail = "[[cylinder]]\nends = [[3.0, -1.0, 0.9], [3.0, 1.0, 0.9]]\nradius = 0.02\n"
    with pytest.raises(foot_planner.Impassable, match="meets something"):
        foot_planner.walk(scene(rail))


def test_posts_too_near_to_each_other_cannot_be_passed_on_foot(scene):
    posts = "[[cylinder]]\nends = [[3.0, 0.4, 0.0], [3.0, 0.4, 1.0]]\nradius = 0.03\n"
    with pytest.raises(foot_planner.Impassable, match="meets something"):
        foot_planner.walk(scene(posts))


def test_a_balancing_ledge_bears_no_foot(scene):
    ledge = "ditches = [[2.5, 3.5]]\n[[box]]\nx = [2.4, 3.6]\ny = [{}, {}]\nz = [-0.1, 0.0]\n"
    with pytest.raises(foot_planner.Impassable):
        foot_planner.walk(scene(ledge.format(-0.03, 0.03)))
    foot_planner.walk(scene(ledge.format(-0.3, 0.3)))


def test_rays_go_through_holes_and_stop_at_what_is_between():
    # webs of 2 cm begin at x = 1.8 and each 5.6 cm, at y = -0.75 and each 5.92 cm, top 15 cm
    treads = SCENES["perforated_treads"]
    assert down(treads, 1.81, -0.71) == pytest.approx(0.85)  # on a web across
    assert down(treads, 1.838, -0.74) == pytest.approx(0.852)  # on one along, 2 mm lower
    assert down(treads, 1.838, -0.71) == pytest.approx(1.0)  # through a hole, to the floor
    # bars of 4 mm begin at x = 1.8 and each 3 cm; y = 0.05 is between two rods
    grate = SCENES["steel_grate"]
    assert down(grate, 1.802, 0.05) == pytest.approx(0.85)
    assert down(grate, 1.817, 0.05) == pytest.approx(1.0)
    # 1 m under a grate that lies flush
    assert down(SCENES["grate_over_ditch"], 2.5, 0.015) == pytest.approx(2.0)
    assert down(SCENES["grate_over_ditch"], 2.5, 0.0) == pytest.approx(1.0)


def test_an_open_stair_stands_on_a_floor():
    # 28 cm from the eye to the first tread's top at 17 cm; behind it, where no tread is, the floor
    stairs = SCENES["open_risers"]
    assert down(stairs, 1.9, 0.0, z=0.45) == pytest.approx(0.28)
    assert down(stairs, 2.6, 0.0, z=0.3) == pytest.approx(0.3)  # under the third


def test_a_box_is_where_the_file_says_as_often_as_it_says(scene):
    found = scene(
        "[[box]]\nx = [2.0, 2.4]\ny = [-0.5, 0.5]\nz = [0.0, 0.1]\n"
        "count = [2, 3]\nby = [[1.0, 0.0, 0.0], [0.0, 0.0, 0.5]]\n"
    ).solids
    middles = [tuple(np.round(solid.middle, 6)) for solid in found]
    assert middles == [(x, 0.0, z) for x in (2.2, 3.2) for z in (0.05, 0.55, 1.05)]
    np.testing.assert_allclose(found[0].size, [0.2, 0.5, 0.05])


def test_a_part_is_turned_and_put_where_it_is_placed(scene):
    # a box whose middle is 1 m ahead of the part's own; the part is turned left by 90 deg
    found = scene(
        '[[place]]\npart = "block"\nat = [3.0, 0.5, 0.2]\nturn = 90.0\n'
        "[[part.block.box]]\nx = [0.9, 1.1]\ny = [-0.3, 0.3]\nz = [0.0, 0.2]\n"
    )
    np.testing.assert_allclose(found.solids[0].middle, [3.0, 1.5, 0.3], atol=1e-9)
    assert down(found, 3.25, 1.5) == pytest.approx(0.6)  # along x it is 60 cm long now
    assert down(found, 3.0, 1.65) == pytest.approx(1.0)  # and 20 cm across


def test_a_tilted_box_rises_as_its_angle_says(scene):
    # turned by -30 deg about y, the middle of its upper side at z = 0.2 + 0.1 cos 30; a point of
    # that side 0.5 m up along it lies 0.433 m ahead and 0.25 m higher
    ramp = scene(
        "[[box]]\nx = [2.0, 4.0]\ny = [-0.5, 0.5]\nz = [0.1, 0.3]\ntilt = [0.0, -30.0, 0.0]\n"
    )
    top = np.array([3.0 - 0.1 * 0.5, 0.2 + 0.1 * 0.8660254])
    assert down(ramp, top[0], 0.0) == pytest.approx(1.0 - top[1])
    assert down(ramp, top[0] + 0.4330127, 0.0) == pytest.approx(1.0 - top[1] - 0.25)


BOX = "[[box]]\nx = [2.0, 2.5]\ny = [-0.5, 0.5]\nz = [0.0, 0.1]\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("heigth = 3.0\n", "unknown setting 'mine.toml: heigth'"),
        (BOX + 'lok = "wood"\n', "did you mean 'look'"),
        (BOX.replace("[2.0, 2.5]", "[2.5, 2.0]"), "box 1: x must be [from, to], ascending"),
        (BOX.replace("0.1]", "inf]"), "finite"),
        (BOX.replace("z = [0.0, 0.1]\n", ""), "box 1: 'z' is missing"),
        (BOX + "count = [2]\n", "count and by must have equal length"),
        (BOX + "count = [0]\nby = [[1.0, 0.0, 0.0]]\n", "each count be at least 1"),
        (BOX + "count = [90000]\nby = [[1.0, 0.0, 0.0]]\n", "more than 3000"),
        (BOX + 'look = "gold"\n', "must be one of 'concrete'"),
        ("box = [3]\n", "must be dict"),
        ("[[cylinder]]\nends = [[2, 0, 0], [2, 0, 1]]\nradius = -0.1\n", "radius must be above"),
        ("[[cylinder]]\nends = [[2, 0, 0], [2, 0, 0]]\nradius = 0.1\n", "ends must differ"),
        ('[[place]]\npart = "wal"\nat = [2, 0, 0]\n[part.wall]\n', "did you mean 'wall'"),
        ("ditches = [[3.0, 2.0]]\n", "ditches must be"),
        ("part = 3\n", "must be dict"),
    ],
)
def test_a_file_that_cannot_be_used_is_one_line(scene, text, said):
    with pytest.raises(ConfigError) as error:
        scene(text)
    assert said in str(error.value) and "\n" not in str(error.value)


def test_a_scene_has_an_end_and_a_width(scene):
    for head in (HEAD.replace("6.0", "-6.0"), HEAD.replace("1.4", "0.0")):
        with pytest.raises(ConfigError, match="end and width must be above zero"):
            scene("", head)
    with pytest.raises(ConfigError, match="'end' is missing"):
        scene("", HEAD.replace("end = 6.0\n", ""))


def test_an_unknown_scene_is_one_line():
    with pytest.raises(ConfigError, match="did you mean 'steel_grate'"):
        scene_files.load_named("steel_grates")


@pytest.mark.parametrize("mu", [0.4, 0.9, 1.0])
def test_the_friction_asked_for_is_the_one_that_acts(scene, mu):
    body = on(scene(""), mu)
    state = placed(body)
    for _ in range(40):
        mujoco.mj_step(body.model, state)
    assert state.ncon >= 6
    np.testing.assert_allclose(state.contact.friction[:, :2], mu)


@pytest.mark.parametrize(("mu", "slides"), [(0.4, True), (0.6, False)])
def test_a_block_slides_where_friction_is_less_than_the_slope(scene, mu, slides):
    # tan 25 deg = 0.466; with mu = 0.4, a = g (sin 25 - 0.4 cos 25) = 0.59 m/s^2: 0.29 m in 1 s
    ramp = "[[box]]\nx = [2.0, 6.0]\ny = [-1.0, 1.0]\nz = [0.8, 1.0]\ntilt = [0.0, -25.0, 0.0]\n"
    spec = mujoco.MjSpec()
    scene(ramp).add_to(spec, mu)
    angle = -np.radians(25.0)
    block = spec.worldbody.add_body(pos=[4.0 - 0.2 * 0.42262, 0.0, 0.9 + 0.2 * 0.90631])
    block.quat = [np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]
    block.add_freejoint()
    block.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.2, 0.2, 0.1], friction=[mu, 0.005, 0.0001]
    )
    model = spec.compile()
    state = mujoco.MjData(model)
    first = state.qpos[:3].copy()
    for _ in range(round(1.0 / model.opt.timestep)):
        mujoco.mj_step(model, state)
    way = np.linalg.norm(state.qpos[:3] - first)
    assert way == pytest.approx(0.29, rel=0.15) if slides else way < 0.03


def test_a_foot_stands_across_slots_that_its_spheres_would_sink_into(scene):
    # the soles' three rows of spheres lie 9 cm apart, and so do all slots of 4 cm
    slats = "[[box]]\nx = [0.0, 0.05]\ny = [-1.0, 1.0]\nz = [0.1, 0.15]\n"
    ground = scene(slats + "count = [20]\nby = [[0.09, 0.0, 0.0]]\n")
    sunk = {}
    for stops in (True, False):
        body = on(ground._replace(stops_every_link=stops))
        # the rows at x = 0.70, 0.79 and 0.88, in the middle of slots
        state = placed(body, x=0.755, z=ROBOT.standing_height + 0.152)
        for _ in range(30):  # 0.15 s
            mujoco.mj_step(body.model, state)
        sunk[stops] = 0.15 - (state.xpos[body.feet, 2].mean() - foot_planner.ANKLE)
    assert sunk[True] < 0.01 < 0.03 < sunk[False]


def judged(body, state):
    """Return how a trial that begins at the nominal pose ends in this state."""
    return termination.TerminationChecker(body, placed(body)).check(state, body.foot_force(state))


def rail(y):
    """Return a rail along the path at the height of the hands."""
    return f"[[cylinder]]\nends = [[0.2, {y}, 0.6], [5.0, {y}, 0.6]]\nradius = 0.02\n"


def reach(body):
    """Return how far left the left hand comes when the shoulder swings out, the pelvis held, m."""
    state = placed(body)
    shoulder = body.model.joint("left_shoulder_roll_joint").id - 1
    state.ctrl[shoulder] += 0.8  # rad
    hand, furthest = body.model.body("left_wrist_roll_link").id, 0.0
    for _ in range(200):
        state.qpos[:7], state.qvel[:6] = STANDING.base, 0.0
        mujoco.mj_step(body.model, state)
        furthest = max(furthest, state.xpos[hand, 1])
    return furthest


def test_a_rail_stops_a_hand_which_is_no_fall(scene):
    # the hand's capsule, 3.6 cm thick, reaches to y = 0.417 m at the nominal pose
    free, stopped = reach(on(scene(""))), reach(on(scene(rail(0.46))))
    assert free > 0.5
    assert stopped < 0.46
    body = on(scene(rail(0.42)))
    state = placed(body)
    links = {body.model.body(body.model.geom_bodyid[g]).name for g in state.contact.geom.ravel()}
    assert any("wrist" in link for link in links)
    assert judged(body, state) is None


def test_the_torso_in_a_rail_is_a_hit(scene):
    body = on(scene(rail(0.0).replace("0.6", "0.95")))
    assert judged(body, placed(body)) == "hit"


@pytest.mark.parametrize(
    ("changes", "ending"), [({}, None), ({"x": 6.1}, "finished"), ({"y": 0.8}, "strayed")]
)
def test_a_trial_in_a_scene_ends_at_its_end_or_beside_it(scene, changes, ending):
    body = on(scene(""))
    assert judged(body, placed(body, **changes)) == ending


def test_who_does_not_come_forward_stalls_after_ten_seconds(scene):
    body = on(scene(""))
    state = placed(body)
    checker = termination.TerminationChecker(body, state, speed=0.5)
    endings = [checker.check(state, body.foot_force(state)) for _ in range(501)]
    assert endings.index("stalled") == 499  # 500 control steps after the first state


def test_standing_is_no_success(scene):
    trial = run_trial(on(scene("")), Standing(), STANDING, 40.0)
    assert trial.ending in ("stalled", "low", "tilted", "hit")


@pytest.mark.parametrize("latency", [1, 3, 5])
def test_a_late_frame_is_as_old_as_it_is_said_to_be(scene, latency):
    policy = Standing()
    run_trial(on(scene("")), policy, STANDING, 0.5, Disturbance(latency=latency))
    ages = [now - stamp for now, (_, stamp) in zip(policy.came, policy.frames, strict=True)]
    assert len(ages) >= 6
    np.testing.assert_allclose(ages, 0.02 * latency)


def test_lost_frames_never_reach_the_policy(scene):
    body, bad = on(scene("")), Disturbance(dropped=0.5, seed=3)
    whole, less = Standing(), Standing()
    run_trial(body, whole, STANDING, 1.0)
    run_trial(body, less, STANDING, 1.0, bad)
    channel = Channel(bad)
    kept = [stamp for _, stamp in whole.frames if not channel.loses_one()]
    assert [stamp for _, stamp in less.frames] == kept
    assert 0 < len(kept) < len(whole.frames)


def test_a_policy_is_shown_blind_regions(scene):
    policy = Standing()
    run_trial(on(scene("")), policy, STANDING, 0.5, Disturbance(invalid=0.4))
    for image, _ in policy.frames:
        missing = np.isnan(image) | (image == 0.0)
        assert missing.mean() >= 0.4 - 1e-3


def test_scenes_are_not_among_the_terrains():
    with pytest.raises(ConfigError, match="unknown terrain"):
        lanes.build(dataclasses.replace(config.Terrain(), name="steel_grate"))
