"""Check this machine and say what to do: `python -m cref_jax.doctor`."""

import cref_jax.system.startup  # noqa: F401

import importlib.metadata
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from packaging.requirements import Requirement

from cref_jax import cli, deploy
from cref_jax.config import folders
from cref_jax.env import environment
from cref_jax.env.world import build_world
from cref_jax.evaluation import crossing, whole_robot
from cref_jax.policy import reader, sources
from cref_jax.system import jax_setup, parallel
from cref_jax.training import devices
from cref_jax.whole_body.simulator import WholeBodySim
from cref_jax.whole_body.trial import Episode, run_trial

DISTRIBUTION = "cref-jax"
LEAST_MEMORY = 4 * 2**30  # bytes; the CPU preset of `mixed` needs 3 GiB
LEAST_DISK = 2 * 2**30  # bytes; checkpoints, logs and compiled programs of some runs
DRAW = (
    "import cref_jax.system.startup, mujoco; "
    "mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'))"
)
WALK_SECONDS = 2.0
CLOSE = 0.01  # m, between depths of JAX and of MuJoCo's rays
ALIKE = 0.99  # of the pixels


@dataclass(frozen=True)
class Options(cli.DebugOption):
    """Check Python, packages, devices, memory, drawing, folders, physics and depth."""


class Finding(NamedTuple):
    """What was found; a cure where it is not right."""

    said: str
    cure: str = ""
    prevents: bool = False  # training or walking


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; exit code 1 if something prevents training."""
    with cli.one_line_errors(arguments):
        cli.parse(Options, arguments, "doctor")
        jax_setup.prepare()
        prevented = False
        for name, check in CHECKS.items():
            if prevented and check is check_simulation:
                break
            for finding in check():
                mark = "ok" if not finding.cure else "WRONG" if finding.prevents else "note"
                print(f"{mark:<6}{name:<12}{finding.said}", flush=True)
                if finding.cure:
                    print(f"{'':<18}-> {finding.cure}", flush=True)
                prevented |= finding.prevents
        sys.exit(1 if prevented else 0)


def check_python() -> Iterator[Finding]:
    """Check the interpreter."""
    yield Finding(f"{sys.version.split()[0]} at {sys.executable}")


def check_packages() -> Iterator[Finding]:
    """Compare the versions of the packages with those that are needed, and with those tested."""
    tested, others = _read_tested(), []
    try:
        needed = [Requirement(line) for line in importlib.metadata.requires(DISTRIBUTION) or []]
    except importlib.metadata.PackageNotFoundError:
        yield Finding(f"{DISTRIBUTION} is not installed", "pip install --editable .")
        return
    for package in needed:
        if package.marker and not package.marker.evaluate({"extra": ""}):
            continue
        try:
            version = importlib.metadata.version(package.name)
        except importlib.metadata.PackageNotFoundError:
            yield Finding(f"{package.name} is missing", f'pip install "{package}"', True)
            continue
        if not package.specifier.contains(version, prereleases=True):
            yield Finding(f"{package.name} {version}", f'pip install "{package}"', True)
        elif tested.get(package.name.lower(), version) != version:
            others.append(f"{package.name} {version} ({tested[package.name.lower()]})")
    main = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("jax", "mujoco"))
    if others:
        cure = "nothing, unless something fails: then install the versions in brackets"
        yield Finding(f"{main}; not the tested versions: {', '.join(others)}", cure)
    else:
        yield Finding(f"{main}; all as tested")


def _read_tested() -> dict[str, str]:
    """Read the versions that were tested with this Python, by name; nothing if none was."""
    name = f"py{sys.version_info.major}{sys.version_info.minor}.txt"
    file = folders.data_folder("constraints") / name
    lines = file.read_text().splitlines() if file.is_file() else ()
    pairs = (line.split("==") for line in lines if "==" in line and not line.startswith("#"))
    return {package.strip().lower(): version.split()[0] for package, version in pairs}


def check_devices() -> Iterator[Finding]:
    """Find out what the program runs on."""
    try:
        found = jax.devices()
    except (RuntimeError, AssertionError):  # JAX asserts that there is one
        asked = os.environ.get("JAX_PLATFORMS", "")
        yield Finding(f"no device ('{asked}')", "unset JAX_PLATFORMS, or mend the driver", True)
        return
    kind = f"{len(found)} x {found[0].device_kind} ({found[0].platform})"
    has_gpu = (
        shutil.which("nvidia-smi")
        and not subprocess.run(["nvidia-smi"], capture_output=True, check=False).returncode
    )
    if found[0].platform == "cpu" and has_gpu:
        yield Finding(f"{kind}; an NVIDIA GPU is not used", "pip install 'cref-jax[cuda13,warp]'")
    elif found[0].platform == "cpu" and jax_setup.has_cuda_plugin():
        yield Finding(f"{kind}; CUDA's plugin finds no GPU", "look at nvidia-smi: the driver")
    else:
        yield Finding(kind)


def check_limits() -> Iterator[Finding]:
    """Read cores and memory as this process may use them."""
    cores, all_cores = parallel.cores(), os.cpu_count() or 1
    few = f" of {all_cores}" if cores < all_cores else ""
    memory = devices.main_memory()
    said = f"{cores}{few} cores, {memory / 2**30:.1f} GiB of memory"
    small = memory < LEAST_MEMORY
    yield Finding(said, "train with --num-envs 64, or give the container more" if small else "")


def check_drawing() -> Iterator[Finding]:
    """Draw a picture in a process of its own, since a broken OpenGL may end it."""
    drawn = subprocess.run([sys.executable, "-c", DRAW], capture_output=True, check=False)
    way = os.environ.get("MUJOCO_GL", "the display")
    if drawn.returncode:
        cure = "apt-get install libegl1 libosmesa6 libgl1; only films and pictures need it"
        yield Finding(f"no OpenGL (MUJOCO_GL={way})", cure)
    else:
        yield Finding(f"OpenGL by {way}")


def check_folders() -> Iterator[Finding]:
    """Check that runs and compiled programs can be written, and how much fits."""
    cache = jax.config.jax_compilation_cache_dir
    if cache is None or not os.access(cache, os.W_OK):
        yield Finding("compiled programs cannot be kept", "set XDG_CACHE_HOME to a folder of yours")
    else:
        size = sum(file.stat().st_size for file in Path(cache).iterdir()) / 2**20
        yield Finding(f"compiled programs in {cache}, {size:.0f} MiB")
    free = shutil.disk_usage(Path.cwd()).free
    if not os.access(Path.cwd(), os.W_OK):
        yield Finding(f"runs cannot be written in {Path.cwd()}", "change to another folder", True)
    elif free < LEAST_DISK:
        yield Finding(
            f"{free / 2**30:.1f} GiB of disk left", "make room: a run takes 100 MiB and more"
        )
    else:
        yield Finding(f"runs in {Path.cwd() / 'runs'}, {free / 2**30:.0f} GiB left")


def check_runtime() -> Iterator[Finding]:
    """Run the bundled policy's own test."""
    try:
        times = deploy.self_test(sources.bundled_policy())
    except deploy.PolicyFormatError as error:
        yield Finding(f"the bundled policy: {error}", "install the program again", True)
        return
    yield Finding("the bundled policy matches its training network; " + deploy.report(times)[1])


def check_simulation() -> Iterator[Finding]:
    """Walk the whole robot before a gap, and compare the depth images of JAX and of MuJoCo."""
    began, path = time.monotonic(), sources.bundled_policy()
    policy = reader.read(path)
    physics = build_world(policy.config, "mujoco").physics
    world = crossing.crossing_world(policy.config, physics, "gap", 0.5)
    runtime = deploy.Policy(*deploy.contents(path))
    body = WholeBodySim(world.config, whole_robot.to_lane(world), runtime.joints.names)
    start = whole_robot.initial_states(world, 0, 1)[0]
    at_rest = start._replace(q=body.robot.nominal_pose[body.driven])
    theirs = body.image(Episode(body, runtime, at_rest).state)
    robot = jax.tree.map(lambda a: a[0], crossing.first_robots(world, 0, 1).env)
    qpos = robot.body.qpos.at[7:].set(physics.robot.rest_pose)
    robot = robot.replace(body=robot.body._replace(qpos=qpos))
    far = world.config.camera.d_max
    ours = (np.asarray(jax.jit(environment.depth_image)(world, robot)) + 0.5) * far
    alike = float(np.mean(np.abs(ours - np.minimum(theirs, far)) < CLOSE))
    walked = run_trial(body, runtime, start, WALK_SECONDS).progress
    yield Finding(
        f"depth by JAX and by MuJoCo within 1 cm on {100 * alike:.1f} % of the pixels",
        "" if alike > ALIKE else "please report this, with the lines above",
        alike <= ALIKE,
    )
    seconds = time.monotonic() - began
    yield Finding(
        f"the robot walked {walked:.1f} m in {WALK_SECONDS:g} s ({seconds:.0f} s with compilation)",
        "" if walked > 0.3 else "please report this, with the lines above",
        walked <= 0.3,
    )


CHECKS: dict[str, Callable[[], Iterator[Finding]]] = {
    "python": check_python,
    "packages": check_packages,
    "device": check_devices,
    "limits": check_limits,
    "drawing": check_drawing,
    "folders": check_folders,
    "runtime": check_runtime,
    "simulation": check_simulation,
}


if __name__ == "__main__":
    main()
