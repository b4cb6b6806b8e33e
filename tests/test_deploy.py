import ast
import threading

import jax.numpy as jnp
import numpy as np
import pytest
from tiny_policy import ROBOT, SMALL, J, contents, metres, policy, recorded

from cref_jax import config, deploy, depth, terrain
from cref_jax.deploy import Status
from cref_jax.policy import reference_vectors, runtime_file
from cref_jax.policy.sources import bundled_policy
from cref_jax.runtime.camera import Camera
from cref_jax.runtime.tables import Table

PERIOD = 0.02


def runtime(variant="full", net=SMALL, **guards):
    manifest, arrays = contents(policy(variant, net))
    manifest["guards"].update(guards)
    return deploy.Policy(manifest, arrays, careful=False)  # random inputs agree on nothing


@pytest.fixture
def robot():
    return runtime()


def still(**changes):
    """Return the inputs of a robot that stands at its nominal pose."""
    inputs = {
        "angular_velocity": np.zeros(3),
        "gravity": np.array([0.0, 0.0, -1.0]),
        "command": np.array([0.5, 0.0, 0.0]),
        "q": ROBOT.nominal_pose,
        "qd": np.zeros(J),
        "now": 0.0,
    }
    return list((inputs | changes).values())


def frame(value=1.5):
    return np.full((48, 64), value, np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("variant", deploy.VARIANTS)
def test_it_says_what_the_network_says_over_1000_steps_with_resets(variant):
    trained = policy(variant, config.Network())
    steps = recorded(1000, sees=variant != "blind")
    ours, worst = runtime(variant, config.Network(), rate_rad=[1e6] * J, beyond_rad=[1e6] * J), {}
    expected = reference_vectors.compute_reference(
        trained.config.network, trained.train, ROBOT, trained.config.robot, steps
    )
    expected = {name: np.asarray(x) for name, x in expected.items()}
    assert len(expected) == {"blind": 11, "no_cross_attention": 14, "hpl": 6}.get(variant, 15)
    for t in range(1000):
        if steps.reset[t]:
            ours.reset()
        if steps.fresh[t]:
            assert ours.on_depth(metres(steps.image[t]), t * PERIOD) == Status.OK
        target = ours.step(*(x[t] for x in steps[:5]), t * PERIOD)
        assert not ours.status & (deploy.FAULTS | Status.RATE_LIMITED | Status.RANGE_LIMITED)
        said = ours.tensors() | {"target": target}
        for name, tensor in expected.items():
            error = np.abs(said[name] - tensor[t]).max() / np.abs(tensor).max()
            worst[name] = max(worst.get(name, 0.0), float(error))
    assert steps.reset.sum() > 10
    assert max(worst.values()) < 1e-5, worst


def tokens(robot, depth) -> np.ndarray:
    robot.reset()
    robot.on_depth(depth, 0.0)
    robot.step(*still())
    return robot.tensors()["tokens"]


def test_what_is_beyond_reach_reads_as_the_far_plane_and_millimetres_as_metres(robot):
    far, depth = frame(), frame()
    far[:10] = 3.0
    depth[:5], depth[5:10] = np.inf, 7.0
    np.testing.assert_array_equal(tokens(robot, depth), tokens(robot, far))
    assert np.abs(tokens(robot, frame()) - tokens(robot, far)).max() > 1e-3
    millimetres = np.where(np.isfinite(depth), 1000 * depth, 60_000).astype(np.uint16)
    np.testing.assert_array_equal(tokens(robot, millimetres), tokens(robot, far))


def test_a_window_shows_the_nearest_of_the_pixels_around_as_training_did():
    manifest, arrays = contents(policy("full", SMALL))
    manifest["depth"]["window"] = 3
    depth_image = np.random.default_rng(1).uniform(0.3, 2.9, (48, 64)).astype(np.float32)
    nearest = np.asarray(depth.min_filter(jnp.asarray(depth_image), 3))
    np.testing.assert_allclose(
        tokens(deploy.Policy(manifest, arrays), depth_image), tokens(runtime(), nearest), atol=1e-6
    )


@pytest.mark.parametrize("nothing", [0.0, np.nan, -1.0])
def test_level_ground_has_no_holes(robot, nothing):
    # 1 m over the ground, looking down by 45 degrees: 1 / depth is linear down the image
    down = np.linspace(-0.4, 0.4, 48)[:, None]
    depth = np.broadcast_to(np.sqrt(2.0) / (1.0 + down), (48, 64)).astype(np.float32)
    holes = depth.copy()
    holes[10:30, 20:50], holes[40:, :15], holes[3], holes[5:8, 60:] = [nothing] * 4
    np.testing.assert_allclose(tokens(robot, holes), tokens(robot, depth), atol=2e-3)
    as_far = np.where(holes == depth, depth, 3.0)
    assert np.abs(tokens(robot, as_far) - tokens(robot, depth)).max() > 0.1


@pytest.mark.parametrize(
    ("depth", "stamp", "said"),
    [
        (np.zeros((64, 48), np.float32), 0.0, Status.BAD_DEPTH),
        (np.ones((48, 64), np.int64), 0.0, Status.BAD_DEPTH),
        (None, 0.0, Status.BAD_DEPTH),
        (np.ma.masked_less(frame(), 2.0), 0.0, Status.BAD_DEPTH),
        ("depth", 0.0, Status.BAD_DEPTH),
        (frame(), float("nan"), Status.BAD_DEPTH),
        (frame(), None, Status.BAD_DEPTH),
        (frame(0.0), 0.0, Status.INVALID_DEPTH),
        (frame(np.nan), 0.0, Status.INVALID_DEPTH),
    ],
)
def test_a_frame_that_cannot_be_used_is_not_used(robot, depth, stamp, said):
    robot.on_depth(frame(), 0.0)
    robot.step(*still())
    before = robot.tensors()["tokens"]
    assert robot.on_depth(depth, stamp) == said
    robot.step(*still(now=PERIOD))
    np.testing.assert_array_equal(robot.tensors()["tokens"], before)


def test_it_says_when_there_is_no_frame_and_when_it_is_old(robot):
    robot.step(*still())
    assert robot.status == Status.NO_DEPTH
    robot.on_depth(frame(), 0.01)
    robot.step(*still(now=0.02))
    assert robot.status == Status.OK
    robot.step(*still(now=0.04))
    robot.step(*still(now=0.12))
    assert robot.status == Status.STALE_DEPTH | Status.LATE  # 110 ms; 80 ms since the step before
    robot.step(*still(now=0.11))
    assert robot.status == Status.LATE  # 100 ms is not too old; the clock went back


BAD = [
    {"q": np.zeros(J - 1)},
    {"q": np.full(J, np.nan)},
    {"q": np.rad2deg(ROBOT.nominal_pose)},
    {"q": None},
    {"q": ["a"] * J},
    {"qd": np.full(J, np.inf)},
    {"gravity": np.array([0.0, 0.0, -9.81])},
    {"gravity": np.zeros(3)},
    {"angular_velocity": np.array([1e39, 0.0, 0.0])},
    {"command": np.zeros(3, complex)},
    {"command": np.zeros((1, 3))},
    {"q": np.ma.masked_array(ROBOT.nominal_pose, [True] + [False] * (J - 1))},
    {"now": float("nan")},
    {"now": None},
]


@pytest.mark.parametrize("bad", BAD, ids=lambda bad: str(bad)[:30])
def test_a_bad_input_holds_the_last_target_and_then_lets_the_robot_down(bad):
    robot = runtime(hold_steps=2)
    robot.on_depth(frame(), 0.0)
    good = robot.step(*still())
    memory = robot.tensors()["gru"]
    for _ in range(2):
        np.testing.assert_array_equal(robot.step(*still(**bad)), good)
        assert robot.status & ~Status.LATE == Status.BAD_INPUT | Status.HOLDING
    np.testing.assert_array_equal(robot.tensors()["gru"], memory)
    np.testing.assert_allclose(robot.step(*still(**bad)), ROBOT.nominal_pose)
    assert robot.status & ~Status.LATE == Status.BAD_INPUT | Status.DAMPING
    moved = ROBOT.nominal_pose + np.float32(0.01)
    np.testing.assert_array_equal(robot.step(*still(q=moved)), moved)  # no torque but damping's
    assert robot.status & Status.DAMPING
    robot.reset()
    robot.step(*still())
    assert robot.status == Status.NO_DEPTH


def test_damping_follows_the_joints_as_long_as_they_are_measured():
    robot = runtime(hold_steps=0)
    robot.step(*still())
    moved = ROBOT.nominal_pose + np.float32(0.02)
    np.testing.assert_array_equal(robot.step(*still(q=moved, gravity=None)), moved)
    np.testing.assert_array_equal(robot.step(*still(q=None)), moved)


def test_nothing_raises_where_numpy_is_told_to_raise(robot):
    class Broken:
        def __array__(self, *_, **__):
            raise RuntimeError

    with np.errstate(all="raise"):
        robot.on_depth(frame().astype(np.float64) * 1e300, 0.0)
        robot.on_depth(Broken(), 0.0)
        robot.step(*still(qd=np.full(J, 1e6)))
        robot.step(*still(q=Broken()))
        robot.step(*still(angular_velocity=np.full(3, 1e300)))
        assert robot.status & Status.BAD_INPUT


def test_one_bad_input_is_bridged():
    robot = runtime(hold_steps=2)
    robot.step(*still())
    robot.step(*still(q=None))
    assert robot.status & Status.HOLDING
    robot.step(*still(now=PERIOD))
    assert not robot.status & (Status.HOLDING | Status.DAMPING)


def test_without_a_last_target_a_bad_input_is_no_start(robot):
    np.testing.assert_array_equal(robot.step(*still(qd=None)), ROBOT.nominal_pose)
    assert robot.status & Status.NOT_STARTED


@pytest.fixture
def broken():
    """Return a policy whose answers are not finite."""
    manifest, arrays = contents(policy("full"))
    arrays = {k: np.array(x) for k, x in arrays.items()}
    arrays["action_head/layer_1/bias"][:] = arrays["action_head/layer_2/kernel"][:] = 3e38
    return deploy.Policy(manifest, arrays, careful=False)


def test_the_memory_of_an_answer_that_is_not_finite_is_never_used(broken):
    assert np.isfinite(broken.step(*still())).all()
    assert broken.status & Status.BAD_ACTION


def test_without_a_last_target_an_answer_that_is_not_finite_holds_the_joints(broken):
    for k in range(2):  # where they are now, while they sink
        sunk = ROBOT.nominal_pose + np.float32(0.1 * (k + 1))
        np.testing.assert_array_equal(broken.step(*still(q=sunk, now=k * PERIOD)), sunk)
        assert broken.status & Status.BAD_ACTION and broken.status & Status.HOLDING


def test_commands_stay_within_what_was_trained(robot):
    inside = robot.step(*still(command=np.array([1.0, 0.3, 0.0])))
    robot.reset()
    outside = robot.step(*still(command=np.array([5.0, 9.0, 0.0])))
    assert robot.status & Status.COMMAND_LIMITED
    np.testing.assert_array_equal(inside, outside)


def test_targets_move_no_further_than_the_limits():
    wide = runtime(rate_rad=[1e6] * J, beyond_rad=[1e6] * J)
    narrow = runtime(rate_rad=[1e-4] * J, beyond_rad=[1e6] * J)
    inputs = [still(), still(qd=np.full(J, 5.0), now=PERIOD)]
    first, second = (wide.step(*x) for x in inputs)
    np.testing.assert_array_equal(narrow.step(*inputs[0]), first)
    limited = narrow.step(*inputs[1])
    assert narrow.status & Status.RATE_LIMITED
    np.testing.assert_allclose(limited - first, np.clip(second - first, -1e-4, 1e-4), atol=1e-7)
    inside = runtime(beyond_rad=[0.0] * J, rate_rad=[1e6] * J)
    for t in range(50):
        target = inside.step(*still(qd=np.full(J, -30.0 + t), now=t * PERIOD))
        assert (target >= ROBOT.range_low).all() and (target <= ROBOT.range_high).all()


def test_the_guards_on_targets_take_nothing_that_the_motors_can_do():
    # further from any pose in range the torque is at its limit, even where damping opposes it
    guards = contents(policy("full"))[0]["guards"]
    reach = (ROBOT.effort + ROBOT.kd * ROBOT.velocity_limit) / ROBOT.kp
    np.testing.assert_allclose(guards["beyond_rad"], reach, rtol=1e-6)
    np.testing.assert_allclose(guards["rate_rad"], 2 * reach, rtol=1e-6)


def test_frames_from_another_thread_come_whole(robot):
    robot.on_depth(frame(1.0), 0.0)
    robot.step(*still())
    one = robot.tensors()["tokens"]
    robot.on_depth(frame(2.0), 0.0)
    robot.step(*still())
    two = robot.tensors()["tokens"]
    over = threading.Event()

    def look():
        while not over.is_set():
            robot.on_depth(frame(1.0), 0.0)
            robot.on_depth(frame(2.0), 0.0)

    thread = threading.Thread(target=look)
    thread.start()
    try:
        for t in range(300):
            robot.step(*still(now=t * PERIOD))
            tokens = robot.tensors()["tokens"]
            assert (tokens == one).all() or (tokens == two).all()
    finally:
        over.set()
        thread.join()


def test_the_returned_target_is_the_callers(robot):
    first = robot.step(*still())
    first[:] = 99.0
    assert np.abs(robot.step(*still(q=None))).max() < 10.0


def test_the_file_is_python_3_8():
    ast.parse(runtime_file.join_files(), feature_version=(3, 8))


def image_by_the_manifests_words(depth, words, max_invalid):
    """Compute the network's image as someone would who has only read the manifest."""
    assert words["formula"].startswith("float16(nearest / d_max_m - 0.5)")
    known, far = depth > 0, words["d_max_m"]
    assert 1 - known.mean() <= max_invalid
    inverse = 1 / np.minimum(np.where(known, depth, 1.0), far)
    rows = [r for r in range(48) if known[r].any()]
    lines = {r: np.interp(range(64), np.flatnonzero(known[r]), inverse[r][known[r]]) for r in rows}
    filled = np.array([
        [np.interp(r, rows, [lines[k][c] for k in rows]) for c in range(64)] for r in range(48)
    ])  # fmt: skip
    ready = np.where(known, np.minimum(depth, far), 1 / filled)
    reach = words["window"] // 2
    nearest = np.array([
        [ready[max(r - reach, 0) : r + reach + 1, max(c - reach, 0) : c + reach + 1].min()
         for c in range(64)] for r in range(48)
    ])  # fmt: skip
    return np.float16(nearest / far - 0.5)


@pytest.mark.parametrize("name", ["combined", "mixed", "robust"])
def test_the_manifest_says_all_that_is_done_to_a_frame(name):
    rng, manifest = np.random.default_rng(4), deploy.contents(bundled_policy(name))[0]
    depth_image = rng.uniform(0.3, 4.0, (48, 64)).astype(np.float32)
    depth_image[5], depth_image[20:24, 10:30], depth_image[30:40, :7] = 0.0, np.nan, -1.0
    depth_image[rng.random((48, 64)) < 0.05] = np.inf
    camera = Camera(Table(manifest["depth"], "depth"), 1e-3, 0.5)
    said, image = camera.prepare(depth_image, 0.0, np.zeros(J), None)
    assert said == Status.OK
    words = image_by_the_manifests_words(depth_image, manifest["depth"], 0.5)
    np.testing.assert_allclose(image.astype(np.float16), words, atol=5e-4)


def test_a_larger_frame_of_the_same_view_gives_the_pixels_at_the_cells_middles(robot):
    large = np.arange(480 * 848, dtype=np.float32).reshape(480, 848)
    small = robot.preprocess(large, (58.0, 87.0))
    assert small[0, 0] == large[5, 6]  # middles at 10 r + 5, and at 13.25 c + 6.625
    assert small[47, 63] == large[475, 841]
    np.testing.assert_array_equal(robot.preprocess(large[:, ::-1], (58.0, 87.0)), small[:, ::-1])


def test_a_frame_of_another_view_shows_what_the_renderer_does(robot):
    ground = terrain.from_heights(np.zeros((400, 400), np.float32), 0.02, (-4.0, -4.0))
    axes = np.array([[0.0, -1.0, 0.0], [-0.7, 0.0, -0.7], [0.7, 0.0, -0.7]]).T / np.hypot(0.7, 0.7)
    axes[:, 0] *= np.hypot(0.7, 0.7)
    place, nothing = jnp.array([0.0, 0.0, 1.0]), jnp.zeros((0, 7))
    see = lambda shape, view: np.asarray(
        depth.render(
            ground, place, jnp.asarray(axes), nothing, config.Camera(shape=shape, view=view)
        )
    )
    true = see((48, 64), (58.0, 87.0))
    wide = robot.preprocess(see((480, 640), (70.0, 100.0)), (70.0, 100.0))
    np.testing.assert_allclose(wide, true, atol=0.03)
    narrow = robot.preprocess(see((480, 640), (40.0, 60.0)), (40.0, 60.0))
    seen = narrow > 0
    assert 0.3 < seen.mean() < 0.5 and not seen[0].any() and not seen[:, 0].any()
    np.testing.assert_allclose(narrow[seen], true[seen], atol=0.03)


@pytest.mark.parametrize(
    ("frame", "view"),
    [
        (np.ones((48, 64, 1)), (58.0, 87.0)),
        ("x", (58.0, 87.0)),
        (np.ones((4, 4)), (58.0,)),
        (np.ones((4, 4)), (0.0, 87.0)),
        (np.ones((0, 4)), (58.0, 87.0)),
        (np.ma.masked_less(np.ones((48, 64)), 2.0), (58.0, 87.0)),
    ],
)
def test_what_is_no_frame_or_no_view_is_not_resampled(robot, frame, view):
    with pytest.raises(ValueError, match="must be"):
        robot.preprocess(frame, view)
