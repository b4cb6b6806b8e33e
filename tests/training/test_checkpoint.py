"""A state comes back bit for bit, or the reason is one line; every fault is done to real files."""

import json
import logging
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from cref_jax.errors import CheckpointError, DamagedCheckpoint
from cref_jax.training import checkpoint, pytree_digest, run_lock
from cref_jax.training.checkpoint import Checkpoints

# A read that fails leaves threads of orbax behind that complain of a closed loop.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

HERE = Path(__file__).parent  # where another process finds this file
META = {"config": {"ppo": {"clip": 0.2}, "scan": {"x": [0.0, 1.0, 2]}}, "num_envs": 6}


@flax.struct.dataclass
class Env:
    key: jax.Array
    position: jax.Array
    alive: jax.Array
    contacts: jax.Array


class State(NamedTuple):
    params: dict[str, dict[str, jax.Array]]
    optimiser: optax.OptState
    env: Env
    key: jax.Array
    iteration: jax.Array
    nothing: None = None


def state(seed: int = 0, num_envs: int = 6, width: int = 16) -> State:
    """Return a small state with every kind of leaf that a run carries."""
    key, key_params, key_env = jax.random.split(jax.random.key(seed), 3)
    kernel = jax.random.normal(key_params, (8, width))
    params = {"actor": {"kernel": kernel, "bias": jnp.full(width, jnp.nan, jnp.float32)}}
    env = Env(
        key=jax.random.split(key_env, num_envs),
        position=jax.random.normal(key_env, (num_envs, 3), jnp.bfloat16),
        alive=jnp.arange(num_envs) % 2 == 0,
        contacts=jnp.zeros((num_envs, 0)),
    )
    return State(params, optax.adam(1e-3).init(params), env, key, jnp.int32(seed))


def same(a: State, b: State) -> bool:
    alike = jax.tree.structure(a) == jax.tree.structure(b)
    return alike and pytree_digest.digest(a) == pytree_digest.digest(b)


@pytest.fixture
def run(tmp_path):
    """Return a directory that holds the steps 1, 2 and 3, each with its number as the seed."""
    with Checkpoints(tmp_path / "run") as checkpoints:
        for step in (1, 2, 3):
            checkpoints.save(step, state(step), META)
    return tmp_path / "run"


def arrays_of(step: Path) -> Path:
    """Return the largest file that the arrays of a step lie in."""
    files = [file for file in (step / "state").rglob("*") if file.is_file()]
    return max(files, key=lambda file: file.stat().st_size)


def rewrite_record(step: Path, **changes) -> None:
    """Change the record of a step and seal it again, as another program would have written it."""
    file = step / "meta" / "metadata"
    record = json.loads(file.read_text())["record"] | changes
    file.write_text(json.dumps({"sha256": checkpoint._record_digest(record), "record": record}))


def test_every_leaf_comes_back_bit_for_bit(run):
    with Checkpoints(run) as checkpoints:
        carry, meta = checkpoints.restore(state(99))
    assert same(carry, state(3))
    assert jax.random.key_impl(carry.env.key) == jax.random.key_impl(state().env.key)
    assert isinstance(carry.optimiser[0], optax.ScaleByAdamState)
    assert {key: meta[key] for key in META} == META
    assert meta["iteration"] == 3 and meta["versions"]["jax"] == jax.__version__


def test_a_key_of_another_generator_comes_back_as_one(tmp_path):
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, {"key": jax.random.key(7, impl="rbg")}, {})
        carry, _ = checkpoints.restore({"key": jax.random.key(0, impl="rbg")})
        assert jax.random.key_impl(carry["key"]) == "rbg"
        with pytest.raises(
            CheckpointError, match=r"key is key<rbg>\[\] on disk, key<fry>\[\] here"
        ):
            checkpoints.restore({"key": jax.random.key(0)})


def test_a_restored_state_goes_where_the_fresh_one_lies(run):
    fresh = jax.device_put(state(99), jax.devices()[0])
    with Checkpoints(run) as checkpoints:
        carry, _ = checkpoints.restore(fresh)
    assert carry.params["actor"]["kernel"].sharding == fresh.params["actor"]["kernel"].sharding


def test_a_restored_state_needs_no_second_compilation(run):
    step = jax.jit(lambda s: s._replace(iteration=s.iteration + 1))
    step(state(99))
    with Checkpoints(run) as checkpoints:
        step(checkpoints.restore(state(99))[0])
    assert step._cache_size() == 1


def test_a_relative_directory_will_do(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with Checkpoints("runs/a") as checkpoints:
        checkpoints.save(0, state(), META)
        assert same(checkpoints.restore(state(1))[0], state())


def test_only_the_newest_steps_are_kept(tmp_path):
    with Checkpoints(tmp_path, keep=2) as checkpoints:
        for step in range(5):
            checkpoints.save(step, state(step), META)
        assert checkpoints.steps() == [3, 4]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["3", "4"]


def test_an_older_step_can_be_asked_for(run):
    with Checkpoints(run) as checkpoints:
        assert same(checkpoints.restore(state(99), step=2)[0], state(2))
        with pytest.raises(CheckpointError, match="no checkpoint of step 7"):
            checkpoints.restore(state(99), step=7)


def test_an_empty_directory_holds_no_checkpoint(tmp_path):
    with Checkpoints(tmp_path / "none") as checkpoints:
        assert checkpoints.latest() is None
        with pytest.raises(CheckpointError, match="none: no checkpoint"):
            checkpoints.restore(state())
    assert not (tmp_path / "none").exists()


def test_saving_the_same_state_twice_writes_once(run):
    with Checkpoints(run) as checkpoints:
        carry, meta = checkpoints.restore(state(99))
        before = arrays_of(run / "3").stat().st_mtime_ns
        checkpoints.save(3, carry, meta)
    assert arrays_of(run / "3").stat().st_mtime_ns == before


def test_a_fresh_run_does_not_write_into_an_old_one(run):
    with (
        Checkpoints(run) as checkpoints,
        pytest.raises(CheckpointError, match="contains step 3 of"),
    ):
        checkpoints.save(1, state(), META)
    assert sorted(path.name for path in run.iterdir()) == ["1", "2", "3"]


def test_a_run_that_goes_back_sets_the_abandoned_steps_aside(run):
    with Checkpoints(run) as checkpoints:
        checkpoints.restore(state(99), step=1)
        checkpoints.save(2, state(22), META)
        assert checkpoints.steps() == [1, 2]
        assert same(checkpoints.restore(state(99))[0], state(22))
    assert sorted(p.name.split("-")[0] for p in run.iterdir()) == ["1", "2", "2.aside", "3.aside"]


def test_with_other_environments_only_the_learned_parts_come_back(run, caplog):
    fresh = state(99, num_envs=10)
    with Checkpoints(run) as checkpoints:
        with pytest.raises(
            CheckpointError, match=r"3: env/key is key<fry>\[6\] on disk, .*\[10\] here"
        ):
            checkpoints.restore(fresh)
        assert checkpoints.meta()["num_envs"] == 6
        carry, _ = checkpoints.restore(fresh, parts=("params", "optimiser"))
        checkpoints.save(3, carry, META | {"num_envs": 10})
        assert same(checkpoints.restore(fresh)[0], carry)
    assert same(carry, fresh._replace(params=state(3).params, optimiser=state(3).optimiser))
    assert "3 set aside as 3.aside-" in caplog.text


def test_a_part_that_the_state_lacks_is_named(run):
    with Checkpoints(run) as checkpoints:
        with pytest.raises(CheckpointError, match="no part 'parms'"):
            checkpoints.restore(state(), parts=("parms",))
        with pytest.raises(CheckpointError, match="parms/actor/bias is absent on disk"):
            checkpoints.restore_part("parms", state().params)


def test_a_reader_takes_the_policy_alone_and_needs_only_its_shapes(run):
    with Checkpoints(run) as checkpoints:
        params = checkpoints.restore_part("params", jax.eval_shape(lambda: state().params))
    assert pytree_digest.digest(params) == pytree_digest.digest(state(3).params)


def test_another_shape_is_named_with_both_sizes(run):
    text = r"3: params/actor/bias is float32\[16\] on disk, float32\[32\] here \(and 5 more\)"
    with Checkpoints(run) as checkpoints, pytest.raises(CheckpointError, match=text):
        checkpoints.restore(state(width=32))


def test_another_dtype_is_not_cast(run):
    half = state()._replace(iteration=jnp.array(0.0, jnp.float16))
    text = r"3: iteration is int32\[\] on disk, float16\[\] here$"
    with Checkpoints(run) as checkpoints, pytest.raises(CheckpointError, match=text):
        checkpoints.restore(half)


def test_a_leaf_too_many_is_named(run):
    with Checkpoints(run) as checkpoints:
        with pytest.raises(CheckpointError, match=r"nothing is absent on disk, float32\[\] here"):
            checkpoints.restore(state()._replace(nothing=jnp.zeros(())))
        with pytest.raises(CheckpointError, match=r"key is key<fry>\[\] on disk, absent here"):
            checkpoints.restore(state()._replace(key=None))


def test_what_is_no_array_is_refused_by_name(tmp_path):
    with Checkpoints(tmp_path) as checkpoints, pytest.raises(TypeError, match="a/0 is a int"):
        checkpoints.save(0, {"a": [3]}, {})


def test_a_truncated_file_names_the_step(run):
    file = arrays_of(run / "3")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with Checkpoints(run) as checkpoints, pytest.raises(DamagedCheckpoint) as caught:
        checkpoints.restore(state(99))
    assert str(caught.value).startswith(f"{run / '3'}: damaged: ")
    assert "\n" not in str(caught.value)


def test_no_bit_flip_anywhere_gives_other_numbers(run):
    draw = random.Random(0)
    caught = 0
    files = [file for file in (run / "3").rglob("*") if file.is_file() and file.stat().st_size]
    with Checkpoints(run) as checkpoints:
        for file in files * 8:
            whole = file.read_bytes()
            broken = bytearray(whole)
            broken[draw.randrange(len(whole))] ^= 1 << draw.randrange(8)
            file.write_bytes(broken)
            try:
                carry, meta = checkpoints.restore(state(99))
                assert same(carry, state(3)) and meta["num_envs"] == 6
            except CheckpointError as error:
                assert str(run / "3") in str(error)
                caught += 1
            file.write_bytes(whole)
        assert same(checkpoints.restore(state(99))[0], state(3))
    assert caught > len(files)


@pytest.mark.parametrize("name", ["state/manifest.ocdbt", "state/d", "state", "meta/metadata"])
def test_missing_files_name_the_step(run, name):
    path = run / "3" / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with Checkpoints(run) as checkpoints, pytest.raises(DamagedCheckpoint, match="run/3: "):
        checkpoints.restore(state(99))


@pytest.mark.parametrize("name", ["_CHECKPOINT_METADATA", "state/_METADATA"])
def test_files_that_only_orbax_needs_may_be_missing(run, name):
    (run / "3" / name).unlink()
    with Checkpoints(run) as checkpoints:
        assert same(checkpoints.restore(state(99))[0], state(3))


def test_a_damaged_step_is_passed_over_only_on_request(run, caplog):
    arrays_of(run / "3").write_bytes(b"")
    with Checkpoints(run) as checkpoints:
        with pytest.raises(DamagedCheckpoint):
            checkpoints.restore(state(99))
        carry, meta = checkpoints.restore(state(99), allow_fallback=True)
        assert same(carry, state(2)) and meta["iteration"] == 2
        assert "falling back to step 2" in caplog.text
        checkpoints.save(3, state(33), META)
        assert same(checkpoints.restore(state(99))[0], state(33))


def test_when_every_step_is_damaged_the_oldest_is_named(run):
    for step in "123":
        arrays_of(run / step).write_bytes(b"")
    with Checkpoints(run) as checkpoints, pytest.raises(DamagedCheckpoint, match="run/1: damaged"):
        checkpoints.restore(state(99), allow_fallback=True)


def test_another_shape_is_no_damage_to_fall_back_from(run):
    with Checkpoints(run) as checkpoints, pytest.raises(CheckpointError, match="run/3: params"):
        checkpoints.restore(state(width=32), allow_fallback=True)


@pytest.mark.parametrize("content", [None, "notes.txt"])
def test_a_numbered_directory_of_someone_else_is_left_alone(run, content, caplog):
    (run / "9").mkdir()
    if content:
        (run / "9" / content).write_text("mine")
    with Checkpoints(run) as checkpoints:
        assert checkpoints.latest() == 3
        assert same(checkpoints.restore(state(99))[0], state(3))
        for step in (4, 5, 6, 7):
            checkpoints.save(step, state(step), META)
        assert checkpoints.steps() == [5, 6, 7]
    assert (run / "9").exists()
    assert caplog.text.count("9 is not a checkpoint; skipped") == 1


def test_a_numbered_directory_in_the_way_is_set_aside(tmp_path):
    (tmp_path / "1").mkdir()
    (tmp_path / "1" / "notes.txt").write_text("mine")
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1), META)
        assert same(checkpoints.restore(state(99))[0], state(1))
    assert next(tmp_path.glob("1.aside-*/notes.txt")).read_text() == "mine"


def test_a_newer_schema_is_refused(run):
    rewrite_record(run / "3", schema=checkpoint.SCHEMA + 1)
    text = r"run/3: written by a newer program \(schema 2, this one reads 1\)"
    with Checkpoints(run) as checkpoints, pytest.raises(CheckpointError, match=text):
        checkpoints.restore(state(99), allow_fallback=True)


def test_other_versions_are_said_and_go_on(run, caplog):
    rewrite_record(run / "3", devices="8 x cpu")
    with Checkpoints(run) as checkpoints:
        assert same(checkpoints.restore(state(99))[0], state(3))
    assert "not bit for bit: devices 8 x cpu -> " in caplog.text


def test_a_disk_that_refuses_leaves_the_last_step_good(run):
    """A limit on the size of files stands in for a full disk."""
    code = """
import resource, sys
from test_checkpoint import META, Checkpoints, state
with Checkpoints(sys.argv[1]) as checkpoints:
    carry, _ = checkpoints.restore(state(99))
    resource.setrlimit(resource.RLIMIT_FSIZE, (600, 600))
    checkpoints.save(4, state(4), META)
"""
    command = [sys.executable, "-c", code, str(run)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=HERE)
    assert done.returncode == 1
    assert "CheckpointError: " + str(run / "4") + ": could not be written: " in done.stderr
    with Checkpoints(run) as checkpoints:
        assert same(checkpoints.restore(state(99))[0], state(3))
        checkpoints.save(4, state(4), META)
    assert sorted(path.name for path in run.iterdir()) == ["2", "3", "4"]


def test_a_directory_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    run = tmp_path / "file" / "run"
    with pytest.raises(CheckpointError, match="file/run: cannot be written: Not a directory"):
        run_lock.lock(run).__enter__()
    text = "run/1: could not be written: NotADirectory"
    with Checkpoints(run) as checkpoints, pytest.raises(CheckpointError, match=text):
        checkpoints.save(1, state(), META)


@pytest.mark.slow
def test_a_kill_at_any_time_leaves_the_last_step_complete(tmp_path):
    code = """
import sys
from test_checkpoint import META, Checkpoints, state
with Checkpoints(sys.argv[1]) as checkpoints:
    newest = checkpoints.latest()
    if newest is not None:
        checkpoints.restore(state(99))
    for step in range(0 if newest is None else newest + 1, 10_000):
        checkpoints.save(step, state(step), META)
        print(step, flush=True)
"""
    draw = random.Random(1)
    for _ in range(5):
        command = [sys.executable, "-c", code, str(tmp_path)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=HERE)
        assert process.stdout is not None
        said = [process.stdout.readline()]
        time.sleep(draw.uniform(0.0, 0.4))
        process.send_signal(signal.SIGKILL)
        said += process.stdout.read().splitlines()
        process.wait()
        with Checkpoints(tmp_path) as checkpoints:
            newest = checkpoints.latest()
            assert newest is not None and newest >= int(said[-1])
            assert same(checkpoints.restore(state(99))[0], state(newest))


def test_two_runs_do_not_share_a_directory(tmp_path):
    with run_lock.lock(tmp_path):
        text = f"in use by process {os.getpid()} on {socket.gethostname()}"
        with pytest.raises(CheckpointError, match=text), run_lock.lock(tmp_path):
            pass
    with run_lock.lock(tmp_path):
        pass


def test_the_lock_of_a_killed_run_is_taken_over(tmp_path, caplog):
    code = """
import sys, time
from cref_jax.training import run_lock
with run_lock.lock(sys.argv[1]):
    print("locked", flush=True)
    time.sleep(60)
"""
    command = [sys.executable, "-c", code, str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=HERE)
    assert process.stdout is not None and process.stdout.readline() == "locked\n"
    with pytest.raises(CheckpointError, match=f"process {process.pid} "):
        run_lock.lock(tmp_path).__enter__()
    process.kill()
    process.wait()
    caplog.set_level(logging.WARNING)
    with run_lock.lock(tmp_path):
        assert (tmp_path / "run.lock").read_text().startswith(f"{os.getpid()} ")
    assert f"taken over from process {process.pid}" in caplog.text


def test_the_lock_of_another_host_is_left_alone(tmp_path):
    (tmp_path / "run.lock").write_text("17 elsewhere\n")
    with pytest.raises(CheckpointError, match=r"process 17 on elsewhere; if it is dead, remove"):
        run_lock.lock(tmp_path).__enter__()


def test_equal_digests_mean_equal_bits():
    tree = {"a": np.zeros(2, np.float32), "b": np.array([0.0])}
    assert pytree_digest.digest(tree) == pytree_digest.digest(dict(reversed(tree.items())))
    others = [
        tree | {"a": np.array([0.0, -0.0], np.float32)},
        tree | {"a": np.zeros(2, np.int32)},
        tree | {"a": np.zeros((2, 1), np.float32)},
        {"a": tree["a"], "c": tree["b"]},
    ]
    assert pytree_digest.digest(tree) not in {pytree_digest.digest(other) for other in others}


def test_a_lock_of_any_bytes_is_read(tmp_path):
    (tmp_path / "run.lock").write_bytes(b"\xff\xfe\x00")
    with run_lock.lock(tmp_path):
        assert (tmp_path / "run.lock").read_text().startswith(f"{os.getpid()} ")
