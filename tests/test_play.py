import imageio_ffmpeg
import jax
import numpy as np
import pytest
from PIL import Image

from cref_jax import play, robot
from cref_jax.config import Config
from cref_jax.env.world import build_world
from cref_jax.errors import ConfigError
from cref_jax.play import Options, Recording
from cref_jax.rendering import robot_scene
from cref_jax.training import iteration, run_dir


@pytest.fixture
def opengl():
    """Skip where nothing can be drawn."""
    model = robot.spec("legs", Config().physics, contact_planes=0).compile()
    try:
        with robot_scene.Canvas(model, 16, 16):
            pass
    except ConfigError as error:
        pytest.skip(str(error))


def refused(capsys, *arguments):
    """Return the one line that a command line is refused with."""
    with pytest.raises(SystemExit) as end:
        play.main(list(arguments))
    assert end.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ") and captured.err.count("\n") == 1
    return captured.err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--terrain", "stair"], "did you mean 'stairs'?"),
        (["--terrain", "stairs", "--kind", "stairs_dwn"], "did you mean 'stairs_down'?"),
        (["--level", "10"], "--level must be 0 to 9, not 10"),
        (["--level", "-1"], "--level must be 0 to 9, not -1"),
        (["--level", "hard"], "'flat' has no level 'hard'; take 0 to 9"),
        (["--seconds", "0"], "--seconds must be 0.02 to 600, not 0.0"),
        (["--seconds", "nan"], "--seconds must be 0.02 to 600, not nan"),
        (["--command", "inf"], "--command must be -10 to 10, not inf"),
        (["--stills", "-1"], "--stills must be 0 to 100, not -1"),
        (["--out", "film.avi"], "--out must end in .mp4"),
        (["--out", "film.mp4", "--stills", "3"], "--out must end in .png"),
        (["--out", "file/film.mp4"], "cannot make the folder file"),
        (["--out", "folder.mp4"], "cannot write folder.mp4"),
        (["--live"], "--live goes without --agent"),
        (["--scene", "curbs"], "--scene goes with --live"),
    ],
)
def test_a_mistake_is_one_line(capsys, monkeypatch, tmp_path, arguments, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "folder.mp4").mkdir()
    assert said in refused(capsys, "--agent", "stand", *arguments)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--scene", "curb"], "did you mean 'curbs'?"),
        (["--scene", "curbs", "--kind", "gap"], "--scene goes without --terrain, --kind"),
        (["--scene", "curbs", "--port", "0"], "--port must be 1 to 65535"),
        (["--policy", "robst"], "no run or policy robst"),
        (["--robot", "g1"], "is of the robot 'x2_ultra', not of 'g1'"),
    ],
)
def test_a_mistake_of_a_live_page_is_one_line(capsys, arguments, said):
    assert said in refused(capsys, "--policy", "robust", "--live", *arguments)


def test_what_is_no_policy_is_refused(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert "not both" in refused(capsys, "--run", "one", "--policy", "another")
    assert "there is no run or policy nowhere" in refused(capsys, "--run", "nowhere")
    assert list(tmp_path.iterdir()) == []


def test_debug_shows_where_a_mistake_was_noticed():
    with pytest.raises(ConfigError):
        play.main(["--agent", "stand", "--seconds", "-1", "--debug"])


def test_a_level_is_a_size_of_the_terrain():
    # stairs rise from 0 to 0.20 m over 10 levels: level 3 is 3 * 0.20 / 9
    c = Config().terrain
    c = type(c)(name="stairs")
    size = lambda **asked: float(play._build_lane(c, Options(**asked)).sizes[0, 0])
    assert size(level=3) == pytest.approx(0.20 / 3)
    assert size(level="ood", kind="stairs_down") == pytest.approx(0.23)
    assert size() == pytest.approx(5 * 0.20 / 9)


def test_the_summary_worked_by_hand():
    # 50 steps of 20 ms are 1 s; the left foot is up in 20 of them, the right one in 10
    airborne = np.zeros((50, 2), bool)
    airborne[:20, 0] = airborne[20:30, 1] = True
    marks = np.full((50, 2, 25, 3), np.nan)
    said = play.summary(Recording(np.zeros((50, 19)), airborne, marks, None, 0.5, "low"), 0.6, 0.02)
    assert "walked 0.50 m in 1.0 s, 0.50 of 0.60 m/s asked for, and fell" in said
    assert "left foot 40%, right foot 20%" in said


@pytest.mark.slow
def test_the_nominal_pose_stands_for_a_moment_and_then_falls():
    options = Options(agent="stand", seconds=4.0)
    world = play._build_world(options, Config())
    recording = play.record(world, None, options)
    assert recording.ending in ("tilted", "low", "hit")
    assert 0.5 < 0.02 * len(recording.qpos) < 4.0
    height = recording.qpos[:25, 2]  # of the first half second
    np.testing.assert_allclose(height, world.physics.robot.standing_height, atol=0.03)
    assert not recording.airborne[:25].any()
    again = play.record(world, None, options)
    np.testing.assert_array_equal(again.qpos, recording.qpos)


@pytest.mark.slow
def test_a_film_has_25_pictures_a_second(opengl, tmp_path, capsys):
    out = tmp_path / "new" / "film.mp4"
    play.main(["--agent", "stand", "--seconds", "0.5", "--out", str(out)])
    # 25 control steps of 20 ms, of which every second one is drawn: 0, 2, ..., 24
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(out))
    assert (frames, seconds) == (13, pytest.approx(13 / 25, abs=0.02))
    assert list(out.parent.iterdir()) == [out]
    assert "still on its feet" in capsys.readouterr().out


@pytest.mark.slow
def test_stills_stand_side_by_side(opengl, tmp_path):
    out = tmp_path / "play.png"
    asked = ["--agent", "random", "--terrain", "gap", "--stills", "3", "--seconds", "0.3"]
    play.main([*asked, "--out", str(out)])
    with Image.open(out) as picture:
        assert picture.size == (3 * play.STILL_WIDTH, play.HEIGHT)


@pytest.mark.slow
def test_a_trained_policy_walks_on_another_terrain(opengl, tmp_path):
    run = tmp_path / "runs" / "mine"
    small = {"lstm": 8, "gru": 8, "token": 8, "actor": [8], "critic": [8]}
    c = play.config.override(Config(), {"run": {"num_envs": 4}, "network": small})
    world = build_world(c, "mujoco")
    state = jax.jit(iteration.initial_state)(world)
    run.mkdir(parents=True)
    run_dir.write_config(run, c)
    with run_dir.checkpoints(run) as steps:
        steps.save(0, state, {"num_envs": 4})
    play.main(["--run", str(run), "--terrain", "stairs", "--level", "easy", "--seconds", "0.2"])
    assert (run / "play.mp4").stat().st_size > 1000
