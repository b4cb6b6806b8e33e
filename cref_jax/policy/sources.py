"""Sources of a policy: a run, a learner file, an export, or the bundled policy."""

import contextlib
from pathlib import Path

from cref_jax.config import Config, folders
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.policy import learner_file, reader, trained
from cref_jax.policy.trained import TrainedPolicy, describe_samples
from cref_jax.robot.registry import describe as describe_robot
from cref_jax.robot.registry import name_robot
from cref_jax.training import run_dir

BUNDLED = "mixed"  # the policy taken where none is named and nothing is trained


def resolve_policy(run: Path | None, policy: Path | None, robot: str | None = None) -> Path:
    """Choose the run or the policy as given, else the newest run, else the bundled policy.

    Raises:
        ConfigError: both are given, or there is none of this robot.
    """
    if run and policy:
        raise ConfigError("give --run or --policy, not both")
    if given := run or (policy and find_policy(policy)):
        check_robot(given, robot)
        return given
    bundled = bundled_policy()
    if robot is not None and robot != _robot_of(bundled):
        describe_robot(robot)
        return run_dir.newest(robot=robot)
    with contextlib.suppress(ConfigError):
        return run_dir.newest(robot=robot)
    return bundled


def check_robot(path: Path, robot: str | None) -> None:
    """Refuse a run or policy of another robot than the one asked for; None: any will do.

    Raises:
        ConfigError: says whose it is.
    """
    if robot is not None:
        describe_robot(robot)
        if robot != (own := _robot_of(path)):
            raise ConfigError(f"{path} is of the robot '{own}', not of '{robot}'")


def _robot_of(path: Path) -> str:
    return name_robot(read_config(path).robot.name)


def bundled_policy(name: str = BUNDLED) -> Path:
    """Return a policy that comes with the package."""
    return folders.data_folder("policies") / name


def find_policy(path: Path) -> Path:
    """Return the path, or the bundled policy of this name where there is no such file."""
    bundled = bundled_policy(str(path))
    return bundled if not path.exists() and bundled.is_dir() else path


def is_run(path: Path) -> bool:
    """Check whether the path is a run and not an exported policy."""
    return path.suffix not in (".zip", ".npz") and not (path / "manifest.json").is_file()


def read_config(path: Path) -> Config:
    """Read the settings that a run, a learner file or an exported policy was trained with.

    Raises:
        ConfigError: it is none of these.
    """
    if not path.exists():
        bundled = sorted(folder.name for folder in folders.data_folder("policies").iterdir())
        raise ConfigError(f"there is no run or policy {path}; bundled are {', '.join(bundled)}")
    if learner_file.is_learner(path):
        return learner_file.read_config(path)
    return (
        run_dir.read_config(path)
        if is_run(path)
        else reader.trained_config(reader.read_contents(path)[0])
    )


def describe(path: Path, policy: TrainedPolicy) -> str:
    """Say in one line which policy it is, and what it was trained on for how long."""
    return _line(path, policy.config, policy.iteration, policy.samples)


def summarize(path: Path) -> str:
    """Say the same of a policy that is not loaded.

    Raises:
        ConfigError: it is neither a run nor a policy.
    """
    c = read_config(path)
    if learner_file.is_learner(path):
        return _line(path, c, *learner_file.read_length(path))
    if is_run(path):
        done = run_dir.checkpoints(path).latest() or 0
        return _line(path, c, done, run_dir.count_samples(path, c, done))
    provenance = reader.read_contents(path)[0]["provenance"]
    return _line(path, c, provenance["iteration"], provenance["samples"])


def _line(path: Path, c: Config, iteration: int, samples: int) -> str:
    sees = "blind" if c.network.variant == "blind" else f"network {c.network.variant}"
    length = describe_samples(c, iteration, samples)
    line = f"{path}: {name_robot(c.robot.name)}, {sees}, trained on {c.terrain.name} for {length}"
    return f"{line}, taught by {', '.join(taught)}" if (taught := c.distillation.teachers) else line


def load(path: Path, world: World) -> TrainedPolicy:
    """Load the policy of a run, a learner file or an export, for evaluation in JAX.

    Raises:
        ConfigError: it is none of these, or of another robot than the world's.
        CheckpointError: the run has no readable checkpoint.
    """
    check_robot(path, name_robot(world.config.robot.name))
    if learner_file.is_learner(path):
        return learner_file.read(path, world)
    return trained.load_policy(path, world) if is_run(path) else reader.read(path, world)
