"""The command line of training: what it refuses, what it writes, and that it resumes exactly."""

import contextlib
import dataclasses
import functools
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import jax
import numpy as np
import pytest
from compilation import AS_SHIPPED
from small_world import assert_equal

from cref_jax import config, export, train
from cref_jax.env.world import build_world
from cref_jax.errors import CheckpointError, ConfigError
from cref_jax.policy import reader, sources, trained, writer
from cref_jax.training import devices, iteration, resumption, run_dir, trainer
from cref_jax.training.checkpoint import Checkpoints
from cref_jax.training.progress import Reporter

TINY = ["--terrain", "flat", "--experiment", "smoke", "--device", "cpu"]
TINY += ["--no-tensorboard", "--no-evaluate"]
BUNDLED = str(sources.bundled_policy())
TEACHERS = "--distillation.teachers"


def run(folder: Path, *more: str) -> None:
    train.main([*TINY, "--run-dir", str(folder), *more])


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run that has come to its end; who changes it takes a copy."""
    folder = tmp_path_factory.mktemp("runs") / "first"
    run(folder)
    return folder


def test_runs_of_several_seeds_begun_in_one_second_have_names_of_their_own():
    named = lambda seed: train._name(train.Options(terrain="my/map.npy", seed=seed))
    assert len({named(seed) for seed in (0, 1, 2)}) == 3
    assert named(3).startswith("map-seed3-")
    assert train._name(train.Options(terrain="gap", robot="g1")).startswith("gap-g1-")


def test_the_settings_have_the_robots_name_and_numbers():
    _, c = train.parse([*TINY, "--robot", "g1"])
    assert (c.robot.name, c.camera.pitch, c.reward.feet_y_target) == ("g1", 47.6, 0.237)
    _, c = train.parse([*TINY, "--robot.name", "g1", "--camera.pitch", "45"])
    assert (c.robot.name, c.camera.pitch) == ("g1", 45.0)
    _, c = train.parse(TINY)
    assert (c.robot.name, c.camera.pitch) == ("x2_ultra", 50.0)


def test_a_resumed_run_keeps_its_terrain_and_its_experiment(first, tmp_path):
    resume = ["--resume", "--run-dir", str(first)]
    _, c = train.parse([*resume, "--terrain", "flat"])
    assert c.terrain.name == "flat"
    with pytest.raises(ConfigError, match=f"terrain 'flat', not 'gap'; .* --init {first}"):
        train.parse([*resume, "--terrain", "gap"])
    with pytest.raises(ConfigError, match=f"{first} is of the robot 'x2_ultra', not of 'g1'"):
        train.parse([*resume, "--robot", "g1"])
    copy = tmp_path / "copy"
    shutil.copytree(first, copy)
    origin = json.dumps({"command": ["train.py", "--experiment", "smoke"]})
    (copy / "origin.jsonl").write_text(origin + "\n")
    resume = ["--resume", "--run-dir", str(copy)]
    train.parse([*resume, "--experiment", "smoke"])
    with pytest.raises(ConfigError, match="experiment 'smoke', not 'full'"):
        train.parse([*resume, "--experiment=full"])


@pytest.mark.parametrize(
    ("setting", "value", "says"),
    [
        ("--ppo.gamma", "0.9", "--ppo.gamma 0.99, not 0.9"),
        ("--seed", "3", "--run.seed 0, not 3"),
        ("--reward.weights.stumble", "-1", "--reward.weights.stumble -10.0, not -1.0"),
        ("--network.actor", "64", r"--network.actor \(32,\), not \(64,\)"),
    ],
)
def test_a_resumed_run_keeps_its_settings(first, setting, value, says):
    with pytest.raises(ConfigError, match=f"was begun with {says}; .* with --init {first}"):
        train.parse(["--resume", "--run-dir", str(first), setting, value])


def test_a_run_that_has_done_more_than_is_asked_for_is_left_as_it_is(first):
    before = (first / "config.json").read_bytes()
    said = f"{first} has done 2 iterations already; --iterations must be more, not 1"
    with pytest.raises(ConfigError, match=said):
        train.parse(["--resume", "--run-dir", str(first), "--iterations", "1"])
    train.parse(["--resume", "--run-dir", str(first), "--iterations", "2"])
    assert (first / "config.json").read_bytes() == before


def test_a_resumed_run_says_what_changes_and_what_is_not_taken(first, tmp_path):
    arguments = ["--resume", "--run-dir", str(first), "--iterations", "9", "--run.keep", "1"]
    _, c = train.parse([*arguments, "--run.checkpoint-minutes", "2", "--num-envs", "4"])
    assert resumption.describe_changes(run_dir.read_config(first), c) == [
        "--run.num-envs changes from 8 to 4",
        "--run.iterations changes from 2 to 9",
        "--run.checkpoint-minutes changes from 5.0 to 2.0",
        "--run.keep changes from 3 to 1",
    ]
    (tmp_path / "mine.toml").write_text("[ppo]\ngamma = 0.5\n")
    assert resumption.describe_unused(c, str(tmp_path / "mine.toml")) == [
        f"{tmp_path}/mine.toml has --ppo.gamma 0.5, and the run goes on with 0.99"
    ]


def test_wandb_without_its_package_is_one_line_before_anything_is_written(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(SystemExit) as end:
        run(tmp_path / "run", "--wandb")
    assert end.value.code == 2 and not (tmp_path / "run").exists()
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "pip install 'cref-jax[wandb]'" in error


@pytest.mark.slow
def test_training_goes_on_where_wandb_fails(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "wandb", ModuleType("wandb"))  # it has no call at all
    run(tmp_path / "run", "--wandb")
    assert capsys.readouterr().out.count("warning: no more is logged to wandb") == 1
    assert Checkpoints(tmp_path / "run" / "checkpoints").latest() is not None


@pytest.mark.slow
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), SystemExit(1)])
def test_an_error_between_two_chunks_loses_nothing(tmp_path, monkeypatch, error):
    whole = Reporter.chunk

    def chunk(report, done, log, seconds):
        whole(report, done, log, seconds)
        if done == 1:
            raise error

    monkeypatch.setattr(Reporter, "chunk", chunk)
    with pytest.raises(SystemExit):
        run(tmp_path / "run", "--iterations", "9")
    assert Checkpoints(tmp_path / "run" / "checkpoints").latest() == 2


TWO_STAGES = ["--network.variant", "hpl", "--distillation.teacher-iterations", "2"]
TWO_STAGES += ["--iterations", "4"]


@pytest.mark.slow
def test_a_student_that_does_not_fit_leaves_its_teacher_to_resume(tmp_path, monkeypatch, capsys):
    get = trainer.Programs.get

    def refuse(programs, size):
        if programs._world.config.network.variant == "hpl":
            raise ConfigError("8 robots need 9.0 GiB")
        return get(programs, size)

    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(trainer.Programs, "get", refuse)
        run(tmp_path / "run", *TWO_STAGES)
    jax.clear_caches()  # two runs in one process have many mappings, see conftest.py
    run(tmp_path / "run", "--resume")
    assert Checkpoints(tmp_path / "run" / "checkpoints").latest() == 4


@pytest.mark.slow
def test_a_run_of_two_stages_goes_on_from_either_bit_for_bit_and_walks_in_numpy(
    tmp_path, monkeypatch, capsys
):
    run(tmp_path / "straight", *TWO_STAGES)
    said = capsys.readouterr().out
    assert "the teacher is done after 0.0 M samples" in said
    assert "trained for 0.0 M samples (0.0 M by the teacher, 0.0 M by the student)" in said
    whole, folder = Reporter.chunk, tmp_path / "stopped"
    for stopped in (1, 2, 3):  # in the first stage, by Ctrl-C at its end, and in the second
        jax.clear_caches()  # five runs in one process have too many mappings, see conftest.py

        def chunk(report, done, log, seconds, last=stopped):
            whole(report, done, log, seconds)
            if done + 1 == last == 2:
                signal.raise_signal(signal.SIGINT)
            elif done + 1 == last:
                raise OSError(28, "No space left on device")

        ends = contextlib.nullcontext() if stopped == 2 else pytest.raises(SystemExit)
        with monkeypatch.context() as patch, ends:
            patch.setattr(Reporter, "chunk", chunk)
            run(folder, *(["--resume"] if stopped > 1 else TWO_STAGES))
        assert Checkpoints(folder / "checkpoints").latest() == stopped
        if stopped == 1:
            with pytest.raises(ConfigError, match="no student yet, its teacher 1 of 2 iterations"):
                trained.load_policy(folder, build_world(run_dir.read_config(folder)))
    run(folder, "--resume")
    straight, parts = state_of(tmp_path / "straight"), state_of(folder)
    assert all(np.array_equal(a, b) for a, b in zip(straight, parts, strict=True))
    starts = [json.loads(line) for line in (folder / "origin.jsonl").open()]
    # of 8 robots in 24 steps
    assert [start["samples"] for start in starts] == [
        {"teacher": 0, "student": 0},
        {"teacher": 192, "student": 0},
        {"teacher": 2 * 192, "student": 0},
        {"teacher": 2 * 192, "student": 192},
    ]
    export.main(["--run", str(folder), "--out", str(tmp_path / "policy")])
    said = capsys.readouterr().out
    assert "outputs match the trained network" in said and "nothing left to do" not in said
    assert not (tmp_path / "policy" / "cref_policy.c").exists()
    manifest = json.loads((tmp_path / "policy" / "manifest.json").read_text())
    stages = {"teacher": 2 * 192, "student": 2 * 192}
    assert manifest["provenance"]["samples_by_stage"] == stages


@pytest.mark.slow
def test_what_is_not_sound_is_not_saved(tmp_path, monkeypatch):
    def chunk(report, done, log, seconds):
        log["episode/unstable"] = log["episode/unstable"] + 100.0
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Reporter, "chunk", chunk)
    with pytest.raises(SystemExit) as end:
        run(tmp_path / "run")
    assert end.value.code == 1
    assert Checkpoints(tmp_path / "run" / "checkpoints").latest() is None


def test_robots_of_another_version_begin_anew_and_what_was_learned_stays(
    first, tmp_path, monkeypatch, capsys
):
    shutil.copytree(first, tmp_path / "run")
    whole = Checkpoints.restore

    def restore(steps, like, parts=None, **more):
        if parts is None:
            raise CheckpointError("run/2: robots/env/new: absent on disk, float32[8] here")
        return whole(steps, like, parts=parts, **more)

    monkeypatch.setattr(Checkpoints, "restore", restore)
    run(tmp_path / "run", "--resume", "--iterations", "3")
    said = capsys.readouterr().out
    assert "of another version: run/2: robots/env/new" in said and "the robots start anew" in said
    monkeypatch.setattr(Checkpoints, "restore", whole)
    assert Checkpoints(tmp_path / "run" / "checkpoints").latest() == 3


def state_of(folder: Path) -> list[np.ndarray]:
    """Return every number of the newest checkpoint."""
    c = run_dir.read_config(folder)
    like = jax.jit(iteration.initial_state)(build_world(c))
    with Checkpoints(folder / "checkpoints") as steps:
        state, _ = steps.restore(like)
    plain = lambda x: (
        jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    )
    return [np.asarray(plain(x)) for x in jax.tree.leaves(state)]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--terrain", "gpa"], "did you mean 'gap'?"),
        (["--terrain.name", "gap"], "--terrain.name: say --terrain gap"),
        (["--experiment", "smok"], "did you mean 'smoke'?"),
        (["--num-envs", "0"], "--run.num-envs must be 1 to 1000000, not 0"),
        (["--num-envs", "510"], "take 508 or 512"),
        (["--iterations", "-3"], "--run.iterations must be 1 to 10000000, not -3"),
        (["--physics.timestep", "1.0"], "--physics.timestep must be"),
        (["--resume", "--run-dir", "nowhere"], "nowhere is not a run"),
        (["--run-dir", "/dev/null/run"], "cannot write in /dev/null/run: /dev/null is a file"),
        (["--num-processes", "2"], "give --coordinator, --num-processes and --process-id, or none"),
        (
            ["--coordinator", "a:1", "--num-processes", "2", "--process-id", "2"],
            "--process-id must be 0 to 1, not 2",
        ),
        (["--robot", "g2"], "unknown robot 'g2'; known: g1, x2_ultra"),
        (["--robot", "g1", "--init", BUNDLED], "is of the robot 'x2_ultra', not of 'g1'"),
        (["--init", "nowhere"], "no run or policy nowhere; bundled are combined, mixed, robust"),
        (
            ["--terrain", "gap", "--init", BUNDLED, "--network.gru", "9"],
            "has another network: ",
        ),
        (
            ["--terrain", "gap", "--init", BUNDLED, TEACHERS, "gap=mixed"],
            "--distillation.teachers: --ppo.imitation-weight must be above 0",
        ),
        (
            ["--terrain=gap", "--init", BUNDLED, "--ppo.imitation-weight=1", f"{TEACHERS}=gap=b"],
            "no run or policy b; bundled are combined, mixed, robust",
        ),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(
    arguments: list[str],
    says: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        train.main(["--device", "cpu", "--ppo.minibatches", "4", *arguments])
    lines = capsys.readouterr().err.strip().splitlines()
    assert end.value.code == 2
    assert len(lines) == 1 and lines[0].startswith("error: ") and says in lines[0]
    assert not list(tmp_path.iterdir()), "nothing was written"


def test_a_gpu_that_is_not_there_is_an_error_that_names_the_way_to_it(
    capsys: pytest.CaptureFixture[str],
):
    if jax.default_backend() == "gpu":
        pytest.skip("this machine has a GPU")
    with pytest.raises(SystemExit) as end:
        train.main(["--device", "gpu"])
    assert end.value.code == 2
    assert "pip install 'cref-jax[cuda12]'" in capsys.readouterr().err


def test_an_unknown_key_in_an_experiment_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "mine.toml").write_text("[ppo]\nepoch = 3\n")
    with pytest.raises(SystemExit):
        train.main(["--experiment", str(tmp_path / "mine.toml")])
    assert "unknown setting 'ppo.epoch'; did you mean 'epochs'?" in capsys.readouterr().err


def test_settings_come_from_defaults_then_device_then_experiment_then_command_line():
    _, c = train.parse(["--device", "cpu", "--terrain", "flat", "--experiment", "smoke"])
    assert c.ppo.gamma == config.PPO().gamma  # the default
    assert c.run.num_envs == 8  # the experiment's, over the device's
    _, c = train.parse([*TINY, "--ppo.epochs", "7", "--num-envs", "16"])
    assert (c.ppo.epochs, c.run.num_envs) == (7, 16)


def test_a_plugin_that_finds_no_gpu_is_no_silent_run_on_the_cpu(monkeypatch):
    monkeypatch.setattr(train.jax_setup, "has_cuda_plugin", lambda: True)
    chosen = train.jax.config.jax_platforms
    try:
        train.jax.config.update("jax_platforms", None)
        for device in ("auto", "gpu"):
            with pytest.raises(ConfigError, match="plugin is installed and finds no GPU"):
                devices.select_device(device)
        assert devices.select_device("cpu") == "cpu"
        assert devices.select_device("auto") == "cpu"  # JAX_PLATFORMS=cpu, as this sets
    finally:
        train.jax.config.update("jax_platforms", chosen)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["blind", "full"])
def test_a_run_resumed_is_the_run_uninterrupted_bit_for_bit(
    tmp_path: Path, variant: str, monkeypatch: pytest.MonkeyPatch
):
    # The older emitters round a call of two iterations unlike two calls of one.
    as_shipped = functools.partialmethod(jax.stages.Lowered.compile, AS_SHIPPED)
    monkeypatch.setattr(jax.stages.Lowered, "compile", as_shipped)
    settings = ("--network.variant", variant)
    run(tmp_path / "straight", "--iterations", "4", "--run.chunk", "2", *settings)
    run(tmp_path / "halves", "--iterations", "2", *settings)
    run(tmp_path / "halves", "--iterations", "4", "--resume")
    straight, halves = state_of(tmp_path / "straight"), state_of(tmp_path / "halves")
    assert all(np.array_equal(a, b) for a, b in zip(straight, halves, strict=True))
    log = [json.loads(line) for line in (tmp_path / "halves" / "log.jsonl").open()]
    assert [line["iteration"] for line in log] == [1, 2, 3, 4]
    assert len((tmp_path / "halves" / "origin.jsonl").read_text().splitlines()) == 2


@pytest.mark.slow
def test_a_run_begins_as_a_policy_whose_critic_is_gone(first: Path, tmp_path: Path):
    world = build_world(run_dir.read_config(first))
    writer.write(trained.load_policy(first, world), world, tmp_path / "policy")
    policy = reader.read(tmp_path / "policy")
    run(tmp_path / "second", "--init", str(tmp_path / "policy"), "--iterations", "1")
    assert run_dir.read_config(tmp_path / "second").ppo.critic_first == 200
    begun = trained.load_policy(tmp_path / "second", world).train
    for a, b in zip(*(jax.tree.leaves(t.params.actor) for t in (policy.train, begun)), strict=True):
        np.testing.assert_array_equal(a, b)  # the critic alone has learned
    # 2 x 8 x 24 samples were seen before, and as many in half again
    seen = begun.statistics.obs
    assert int(seen.count) == 576
    drift = np.abs(seen.mean - policy.train.statistics.obs.mean)
    assert np.all(drift < 2.0 * np.asarray(seen.std) + 1e-3)


def test_a_run_with_a_readout_is_loaded_where_none_is_trained(first: Path):
    c = run_dir.read_config(first)
    assert c.ppo.readout_weight > 0.0
    without = dataclasses.replace(c, ppo=dataclasses.replace(c.ppo, readout_weight=0.0))
    assert trained.load_policy(first, build_world(without)).train.params.readout is not None


@pytest.mark.slow
@pytest.mark.parametrize("as_file", [False, True])
def test_a_run_begins_as_another_run_with_all_that_it_learned(first, tmp_path, as_file):
    source = tmp_path / "learned.npz" if as_file else first
    if as_file:
        export.main(["--run", str(first), "--learner", str(source)])
    run(tmp_path / "second", "--init", str(source), "--iterations", "1")
    assert run_dir.read_config(tmp_path / "second").ppo.critic_first == 0
    log = [json.loads(line) for line in (tmp_path / "second" / "log.jsonl").open()]
    assert log[0]["iteration"] == 1
    world = build_world(run_dir.read_config(first))
    before, after = (trained.load_policy(n, world).train for n in (first, tmp_path / "second"))
    # 2 iterations of 8 x 24 samples, then one more
    assert int(before.statistics.critic_obs.count) == 384
    assert int(after.statistics.critic_obs.count) == 576
    critics = [jax.tree.leaves(t.params.critic) for t in (before, after)]
    moved = max(float(np.abs(a - b).max()) for a, b in zip(*critics, strict=True))
    assert 0.0 < moved < 0.1


@pytest.mark.slow
def test_a_run_learns_from_its_teachers_and_has_them_still_when_it_is_resumed(
    first: Path, tmp_path: Path
):
    shutil.copytree(first, tmp_path / "teacher")
    second, taught = tmp_path / "second", f"flat={tmp_path / 'teacher'}"
    asks = ("--ppo.imitation-weight", "1", TEACHERS, taught)
    run(second, "--init", str(first), *asks, "--iterations", "2")
    shutil.rmtree(tmp_path / "teacher")
    run(second, "--resume", "--iterations", "3")
    log = [json.loads(line) for line in (second / "log.jsonl").open()]
    assert [line["iteration"] for line in log] == [1, 2, 3]
    apart = [line["teacher_kl/flat"] for line in log]
    assert max(apart) > min(apart) > 0.0  # the teacher is the average, and the policy goes on
    assert sources.summarize(second).endswith(f", taught by {taught}")
    assert run_dir.first_option(second, "init") == str(first)  # not what this process began with


@pytest.mark.slow
def test_a_run_goes_on_with_another_number_of_robots_and_keeps_what_it_learned(
    first: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    shutil.copytree(first, tmp_path / "run")
    run(tmp_path / "run", "--iterations", "3", "--num-envs", "4", "--resume")
    assert "num_envs changes from 8 to 4" in capsys.readouterr().out
    c, log = run_dir.read_config(first), (tmp_path / "run" / "log.jsonl").read_text().splitlines()
    samples = [json.loads(line)["train/samples"] / c.ppo.horizon for line in log]
    assert samples == [8, 16, 20]  # two iterations of eight robots, one of four
    with Checkpoints(tmp_path / "run" / "checkpoints") as steps:
        assert steps.latest() == 3


@pytest.mark.slow
def test_robots_that_do_not_fit_are_not_asked_for_again(first, tmp_path, monkeypatch, capsys):
    def refuse(*_):
        raise ConfigError("16 robots need 9.0 GiB")

    shutil.copytree(first, tmp_path / "run")
    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(devices, "check_memory", refuse)
        run(tmp_path / "run", "--iterations", "3", "--num-envs", "16", "--resume")
    assert "16 robots need 9.0 GiB" in capsys.readouterr().err
    assert run_dir.read_config(tmp_path / "run") == run_dir.read_config(first)


@pytest.mark.slow
def test_devices_share_the_robots_and_hold_the_same_parameters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    run(tmp_path / "two", "--devices", "2")
    c = run_dir.read_config(tmp_path / "two")
    mesh = devices.choose_mesh(c)
    world = build_world(c)
    state = jax.jit(iteration.initial_state, static_argnames="mesh")(world, mesh)
    assert [s.data.shape[0] for s in state.robots.begins.addressable_shards] == [4, 4]
    first, second = (s.data for s in state.robots.env.body.qpos.addressable_shards)
    assert not np.array_equal(first, second), "each robot has its own random numbers"
    single = iteration.make_mesh(1)
    alone = jax.jit(iteration.initial_state, static_argnames="mesh")(world, single)
    assert_equal(alone, state)
    _, alone_log = iteration.chunk(world, alone, single, 1)
    state, log = iteration.chunk(world, state, mesh, 2)
    for leaf in jax.tree.leaves(state.train):
        shards = [np.asarray(s.data) for s in leaf.addressable_shards]
        np.testing.assert_array_equal(*shards)
    # the first horizon comes before any update, whose minibatches are each device's
    np.testing.assert_allclose(log["walk/reward"][0], alone_log["walk/reward"][0], rtol=1e-5)
    lines = [json.loads(line) for line in (tmp_path / "two" / "log.jsonl").open()]
    # the same run on the command line, of which the log has six digits
    np.testing.assert_allclose(log["walk/reward"], [x["walk/reward"] for x in lines], rtol=1e-5)
    capsys.readouterr()
    run(tmp_path / "two", "--devices", "1", "--iterations", "3", "--resume")
    assert "shares changes from 2 to 1; the robots go on" in capsys.readouterr().out


@pytest.mark.parametrize("asked", ["3", "0"])
def test_robots_that_cannot_be_shared_out_are_refused(
    asked: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit) as end:
        run(tmp_path / "run", "--devices", asked)
    said = "8 robots in 2 minibatches can be sharded over 1, 2 of the 2 devices here"
    assert end.value.code == 2 and said in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_is_not_overwritten_by_another(first: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as end:
        run(first)
    assert end.value.code == 2 and "add --resume" in capsys.readouterr().err


@pytest.mark.slow
def test_sigterm_saves_what_was_learned(tmp_path: Path):
    command = [sys.executable, "-m", "cref_jax.train", *TINY, "--iterations", "100000"]
    folder = tmp_path / "run"
    with subprocess.Popen([*command, "--run-dir", str(folder)], stdout=subprocess.PIPE) as process:
        log = folder / "log.jsonl"
        while process.poll() is None and not (log.exists() and log.stat().st_size):
            time.sleep(0.2)
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=120) == 0
    with Checkpoints(folder / "checkpoints") as steps:
        assert steps.latest() == len(log.read_text().splitlines())
