import numpy as np
import pytest
from scipy import ndimage

from cref_jax.config import NARROW_VIEW, Randomisation
from cref_jax.runtime.camera import Camera
from cref_jax.runtime.tables import Table
from cref_jax.whole_body import disturbances
from cref_jax.whole_body.disturbances import Channel, Disturbance

SHAPE = (48, 64)
FRAME = np.full(SHAPE, 2.0, np.float32)


def sent(d, count):
    """Return what a policy gets of so many equal frames."""
    channel, frames = Channel(d), []
    for step in range(count):
        channel.send(FRAME, step, 0.0)
        come = channel.receive(step + d.latency)
        assert come is not None
        frames.append(come[0])
    return frames


def blind(frame):
    return np.isnan(frame) | (frame == 0.0)


def test_an_undisturbed_frame_comes_as_it_was_one_step_later():
    channel = Channel(Disturbance())
    assert not any(channel.loses_one() for _ in range(100))
    channel.send(FRAME, 7, 0.14)
    assert channel.receive(7) is None
    frame, stamp = channel.receive(8)
    np.testing.assert_array_equal(frame, FRAME)
    assert stamp == 0.14
    assert channel.receive(9) is None


def test_late_frames_come_in_their_order():
    channel = Channel(Disturbance(latency=5))
    for step in (0, 2, 5):  # the second is on its way before the first has come
        channel.send(FRAME, step, float(step))
    come = {step: channel.receive(step) for step in range(12)}
    assert {step: found[1] for step, found in come.items() if found} == {5: 0.0, 7: 2.0, 10: 5.0}


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
def test_the_stated_share_of_frames_is_lost(share):
    channel = Channel(Disturbance(dropped=share))
    lost = np.mean([channel.loses_one() for _ in range(10_000)])
    assert lost == pytest.approx(share, abs=0.02)  # 4 standard deviations of 0.005


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_the_stated_share_of_the_image_is_blind_in_every_frame(share):
    for seed in range(5):
        for frame in sent(Disturbance(invalid=share, seed=seed), 30):
            assert blind(frame).sum() == round(share * FRAME.size)
            np.testing.assert_array_equal(frame[~blind(frame)], 2.0)


def test_blind_pixels_read_zero_or_nothing():
    frames = np.stack(sent(Disturbance(invalid=0.3), 400))
    assert 0.1 < np.isnan(frames).sum() / blind(frames).sum() < 0.9


@pytest.mark.parametrize("count", [1, 3])
def test_regions_are_large_pieces(count):
    for seed in range(20):
        which = disturbances.regions(SHAPE, 0.4, count, np.random.default_rng(seed))
        assert ndimage.label(which >= 0, np.ones((3, 3)))[1] <= count


def test_regions_stay_for_a_while_and_then_move():
    frames = sent(Disturbance(invalid=0.3), 400)
    changes = [
        k for k in range(1, 400) if not np.array_equal(blind(frames[k]), blind(frames[k - 1]))
    ]
    stays = np.diff([0, *changes])
    assert 20 < len(changes) < 100
    assert stays.min() >= 4 and stays.max() <= 20


def test_it_is_all_in_the_seed():
    bad = Disturbance(dropped=0.3, invalid=0.3, seed=4)
    same, other = sent(bad, 20), sent(bad._replace(seed=5), 20)
    np.testing.assert_array_equal(sent(bad, 20), same)
    assert not np.array_equal(blind(same[0]), blind(other[0]))
    np.testing.assert_array_equal(sent(bad._replace(dropped=0.0), 20), same)


def test_losing_frames_does_not_change_which_pixels_are_blind():
    bad = Disturbance(dropped=0.5, invalid=0.3, seed=4)
    channel = Channel(bad)
    for _ in range(50):
        channel.loses_one()
    channel.send(FRAME, 0, 0.0)
    np.testing.assert_array_equal(channel.receive(1)[0], sent(bad, 1)[0])


def test_noise_grows_with_the_square_of_the_distance():
    near, far = (np.full(SHAPE, z, np.float32) for z in (1.0, 2.0))
    channel = Channel(Disturbance(noise=0.01))
    for z, frame, deviation in ((1.0, near, 0.01), (2.0, far, 0.04)):
        channel.send(frame, 0, 0.0)
        read = channel.receive(1)[0] - z
        assert read.std() == pytest.approx(deviation, rel=0.05)
        assert abs(read.mean()) < 4.0 * deviation / np.sqrt(FRAME.size)


def test_what_is_nowhere_or_far_stays_so_under_noise():
    channel, frame = Channel(Disturbance(noise=0.02)), FRAME.copy()
    frame[:10], frame[10:20] = np.inf, 300.0
    channel.send(frame, 0, 0.0)
    read, _ = channel.receive(1)
    assert np.isinf(read[:10]).all() and (read[10:20] > 280.0).all()


def test_a_wrong_scale_is_wrong_everywhere():
    for frame in sent(Disturbance(scale=1.05), 3):
        np.testing.assert_allclose(frame, 2.1, rtol=1e-6)


def test_dead_columns_read_nothing_from_top_to_bottom_all_the_time():
    frames = np.stack(sent(Disturbance(dead=0.1, seed=2), 20))
    dead = blind(frames[0]).all(axis=0)
    assert dead.sum() == 6  # a tenth of 64
    np.testing.assert_array_equal(blind(frames), np.broadcast_to(dead, frames.shape))
    other = sent(Disturbance(dead=0.1, seed=3), 1)[0]
    assert not np.array_equal(blind(other), blind(frames[0]))


def test_a_stream_of_4_to_3_lacks_the_outer_columns_and_no_row():
    (frame,) = sent(Disturbance(view=NARROW_VIEW), 1)
    # The middle of column i is |2 i + 1 - 64| / 64 of tan 43.5 deg = 0.9490 from the axis. 75 deg
    # show up to tan 37.5 deg = 0.7673, 0.8086 of it; column 5 is at 53 / 64 = 0.828, 6 at 0.797.
    missing = np.isin(np.arange(64), [*range(6), *range(58, 64)])
    np.testing.assert_array_equal(blind(frame), np.broadcast_to(missing, SHAPE))
    np.testing.assert_array_equal(frame[:, ~missing], 2.0)


def test_the_runtime_places_a_frame_of_640_x_480_with_the_same_pixels_missing():
    view = {"vertical": 58.0, "horizontal": 87.0}
    words = {"rows": 48, "columns": 64, "d_max_m": 3.0, "view_deg": view}
    camera = Camera(Table(words, "depth"), 1e-3, 0.5)
    placed = camera.resample(np.full((480, 640), 2.0, np.float32), NARROW_VIEW)
    np.testing.assert_array_equal(placed, sent(Disturbance(view=NARROW_VIEW), 1)[0])


def test_an_error_changes_nothing_else():
    bad = Disturbance(invalid=0.3, seed=4)
    noisy = sent(bad._replace(noise=0.01), 5)
    for a, b in zip(sent(bad, 5), noisy, strict=True):
        np.testing.assert_array_equal(blind(a), blind(b))


def test_a_trials_camera_is_drawn_within_the_ranges_of_training():
    ranges = Randomisation(
        depth_noise=0.01, depth_scale=0.03, depth_dead=0.1, depth_holes=0.2, narrow_view=0.5
    )
    draw = lambda ranges, k: disturbances.sample_disturbance(ranges, 2, np.random.default_rng(k))
    drawn = [draw(ranges, k) for k in range(400)]
    for name, low, high in (
        ("noise", 0.0, 0.01), ("scale", 0.97, 1.03), ("dead", 0.0, 0.1), ("invalid", 0.0, 0.2),
    ):  # fmt: skip
        values = np.array([getattr(d, name) for d in drawn])
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high
    assert 150 < sum(d.view == NARROW_VIEW for d in drawn) < 250
    assert {d.latency for d in drawn} == {2} and len({d.seed for d in drawn}) == 400
    assert draw(Randomisation(), 0)._replace(seed=0) == Disturbance(latency=2)
