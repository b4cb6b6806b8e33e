"""Success of an exported policy in scenes outside its training, with good and bad frames.

The policy runs in numpy alone on the whole robot. Each trial is drawn from the seed, the scene's
name and its own number, so it does not depend on the other trials and is the same under every
condition: two conditions differ only in what they change.
"""

import cref_jax.system.startup  # noqa: F401

import functools
import math
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.progress import track

from cref_jax import deploy, robot
from cref_jax.config import NARROW_VIEW, Config
from cref_jax.errors import ConfigError
from cref_jax.evaluation import lateral_drift, protocol, scene_results
from cref_jax.evaluation.protocol import COMMANDS, TRIAL_SECONDS
from cref_jax.evaluation.scene_results import Condition, TrialOutcome, Verdict
from cref_jax.policy import sources
from cref_jax.rendering import robot_scene
from cref_jax.rendering.video import write_video
from cref_jax.system import parallel
from cref_jax.whole_body import scene_files
from cref_jax.whole_body.disturbances import UNDISTURBED, Disturbance
from cref_jax.whole_body.scene_files import Scene
from cref_jax.whole_body.simulator import WholeBodySim
from cref_jax.whole_body.trial import Start, Trial, run_trial

START_X, START_Y = (0.5, 1.0), (-0.3, 0.3)  # m; assumed: as in training
START_YAW = (-0.2, 0.2)  # rad; assumed
FRAME_RATE = 25.0  # 1/s, of a film
SIZE = (960, 540)  # pixels, of a film
VIEW = (12.0, -24.0)  # deg, azimuth and elevation: from behind, so no wall is in the way

GOOD = Condition("undisturbed")
CONDITIONS = (
    *(
        Condition(f"{100 * p:.0f} % of frames lost", Disturbance(dropped=p))
        for p in (0.1, 0.3, 0.5)
    ),
    *(Condition(f"frames {20 * k} ms late", Disturbance(latency=k)) for k in (1, 2, 3, 4, 5)),
    *(Condition(f"{100 * p:.0f} % of pixels blind", Disturbance(invalid=p)) for p in (0.2, 0.4)),
    *(Condition(f"noise of {100 * n:g} cm at 1 m", Disturbance(noise=n)) for n in (0.005, 0.02)),
    *(Condition(f"depth times {k}", Disturbance(scale=k)) for k in (0.95, 1.05)),
    Condition("a tenth of the columns dead", Disturbance(dead=0.1)),
    Condition("a stream of 640 x 480", Disturbance(view=NARROW_VIEW)),
    *(Condition(f"friction {mu}", friction=mu) for mu in (0.4, 0.6, 0.8, 1.0)),
)  # latency assumes control steps of 20 ms, Sec. II-D


class _Job(NamedTuple):
    """One trial to run."""

    scene: str
    number: int
    condition: Condition


def run_scenes(
    policy: Path | None = None,
    trials: int = 10,
    stress_trials: int = 2,
    seed: int = 0,
    seconds: float = TRIAL_SECONDS,
    scenes: Mapping[str, Scene] | None = None,
    workers: int | None = None,
) -> Verdict:
    """Evaluate the policy in all scenes, undisturbed and under each condition.

    Args:
        policy: directory or .zip written by `export` (default: the bundled policy).
        trials: per scene, undisturbed.
        stress_trials: per scene and condition in CONDITIONS; 0 skips the conditions.
        seed: of starts, commands and disturbances.
        seconds: time limit of a trial.
        scenes: to evaluate (default: those of `terrains/ood`).
        workers: trials run in parallel (default: one per core).

    Raises:
        ConfigError: a number of trials or the seed is out of range, or the policy does not exist.
    """
    if trials < 1 or stress_trials < 0 or seed < 0:
        raise ConfigError(
            "trials must be at least 1, stress trials and seed at least 0, not "
            f"{trials}, {stress_trials} and {seed}"
        )
    path, grounds = policy or sources.bundled_policy(), dict(scenes or scene_files.load_all())
    arguments = (path, grounds, seed, seconds)
    _Runner(*arguments)  # reject an invalid policy before starting processes
    conditions = (GOOD, *(CONDITIONS if stress_trials else ()))
    jobs = [
        _Job(name, number, condition)
        for condition in conditions
        for name in grounds
        for number in range(trials if condition is GOOD else stress_trials)
    ]
    table = {condition: {name: [] for name in grounds} for condition in conditions}
    outcomes = parallel.run(_Runner, arguments, jobs, workers)
    for job, outcome in zip(jobs, outcomes, strict=True):
        table[job.condition][job.scene].append(outcome)
    titles = {name: ground.title for name, ground in grounds.items()}
    return scene_results.build_verdict(titles, table)


def film_trial(
    policy: Path | None,
    name: str,
    out: Path,
    seed: int = 0,
    disturbance: Disturbance = UNDISTURBED,
    number: int = 0,
    friction: float = robot.FRICTION,
) -> Trial:
    """Write an .mp4 of one of `run_scenes`' trials in the named scene, and return the trial.

    Raises:
        ConfigError: no such scene or policy, no OpenGL, or the file cannot be written.
    """
    if out.suffix != ".mp4":
        raise ConfigError(f"a film must end in .mp4: {out}")
    ground = scene_files.load_named(name)
    runner = _Runner(policy or sources.bundled_policy(), {name: ground}, seed, TRIAL_SECONDS)
    trial = runner.trial(_Job(name, number, Condition("filmed", disturbance, friction)))
    physics, z = runner.config.physics, -scene_files.DITCH - robot_scene.BASE
    spec = robot_scene.build_stage("all", physics, z, runner.config.robot.name)
    ground.add_to(spec, friction)
    stride = max(1, round(1.0 / (FRAME_RATE * physics.control_period)))
    points = robot_scene.camera_path(trial.qpos, physics.control_period)
    with robot_scene.Canvas(spec.compile(), *SIZE, *VIEW) as canvas:
        moments = track(range(0, len(trial.qpos), stride), "drawing", transient=True)
        frames = (canvas.draw(trial.qpos[t], points[t]) for t in moments)
        write_video(out, frames, 1.0 / (stride * physics.control_period))
    return trial


def sample_start(body: WholeBodySim, name: str, seed: int, number: int) -> Start:
    """Sample the start of trial `number` in the named scene."""
    rng = _rng(name, seed, number)
    x, y, yaw, speed = (
        float(rng.uniform(*limits)) for limits in (START_X, START_Y, START_YAW, COMMANDS)
    )
    quaternion = [math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)]
    base = np.array([x, y, body.robot.standing_height, *quaternion])
    return Start(base, body.robot.nominal_pose[body.driven], speed)


class _Runner:
    """Runner of one policy's trials; caches the compiled scenes."""

    def __init__(self, path: Path, scenes: Mapping[str, Scene], seed: int, seconds: float) -> None:
        if sources.is_run(path):
            raise ConfigError(
                f"{path} is not an exported policy; write one: python -m cref_jax.export"
            )
        self.config: Config = protocol.evaluation_config(sources.read_config(path), seconds)
        self._contents = deploy.contents(path)
        self._scenes, self._seed, self._seconds = scenes, seed, seconds
        self._body = functools.cache(self._build_body)

    def policy(self) -> deploy.Policy:
        """Create the policy in its reset state."""
        return deploy.Policy(*self._contents)

    def __call__(self, job: _Job) -> TrialOutcome:
        """Run a trial and return the measures by which it is counted."""
        t = self.trial(job)
        drift, aside = lateral_drift.measure(t.qpos[:, 1:2])
        return TrialOutcome(
            t.ending, t.seconds, t.progress, t.speed, t.status, float(drift[0]), float(aside[0])
        )

    def trial(self, job: _Job) -> Trial:
        """Run a trial."""
        body = self._body(job.scene, job.condition.friction)
        start = sample_start(body, job.scene, self._seed, job.number)
        disturbance_seed = int(_rng(job.scene, self._seed, job.number, 1).integers(2**32))
        disturbance = job.condition.disturbance._replace(seed=disturbance_seed)
        return run_trial(body, self.policy(), start, self._seconds, disturbance)

    def _build_body(self, name: str, friction: float) -> WholeBodySim:
        return WholeBodySim(self.config, self._scenes[name], self.policy().joints.names, friction)


def _rng(name: str, seed: int, number: int, stream: int = 0) -> np.random.Generator:
    """Create a trial's generator; `stream` is 0 for its start, 1 for its disturbance."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), number, stream])
