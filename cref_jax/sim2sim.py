"""Run an exported policy on the whole robot: `python -m cref_jax.sim2sim --policy policy/`."""

import cref_jax.system.startup  # noqa: F401

import dataclasses
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.progress import track

from cref_jax import cli, deploy
from cref_jax.config import Config, limits
from cref_jax.config.ranges import Within
from cref_jax.env.world import World, build_world
from cref_jax.errors import ConfigError
from cref_jax.evaluation import crossing, protocol, sim2sim_table
from cref_jax.evaluation.crossing import LaneResult
from cref_jax.evaluation.protocol import TRIAL_SECONDS
from cref_jax.evaluation.whole_robot import initial_states, to_lane
from cref_jax.physics.simulation import Physics
from cref_jax.policy import reader, sources
from cref_jax.policy.trained import TrainedPolicy
from cref_jax.rendering import robot_scene, video
from cref_jax.system import jax_setup, parallel
from cref_jax.terrain.generators import KINDS
from cref_jax.whole_body.disturbances import Disturbance, sample_disturbance
from cref_jax.whole_body.ground import Lane
from cref_jax.whole_body.randomization import Perturbation, sample_deviation
from cref_jax.whole_body.simulator import WholeBodySim
from cref_jax.whole_body.trial import Start, Trial, run_trial

FRAME_RATE = 25.0  # 1/s, of a film
SIZE = (960, 540)  # pixels of it


@dataclass(frozen=True)
class Options(cli.DebugOption):
    """Run an exported policy on the whole robot in MuJoCo C, through deploy.py alone."""

    policy: Path | None = None
    """what `python -m cref_jax.export` wrote, or its .zip (default: the bundled policy)"""
    robot: str | None = None
    """a robot by name (default: the policy's own); another robot's policy is an error"""
    kind: Annotated[str, tyro.conf.arg(help=f"kind of lane: {', '.join(KINDS)}")] = "flat"
    size: Annotated[float, Within(0, 100)] = 0.0
    """size of the obstacles, m; for a slope its gradient"""
    trials: Annotated[int, Within(1, 1_000_000)] = 100
    """number of trials, each of up to 40 s"""
    seed: Annotated[int, limits.SEED] = 0
    """seed of initial states and commands, the same as in `eval --suite cross`"""
    latency: Annotated[float, Within(Config().physics.control_period, 10)] = 0.02
    """s from the exposure of a frame until the policy has it, in whole control steps: a frame comes
    with the next step at the earliest"""
    randomised: bool = False
    """vary the robot in each trial, with sensor noise, pushes and faults of the camera, as
    `eval --suite robust` does"""
    compare: bool = False
    """also evaluate the same trials in the training simulation"""
    table: bool = False
    """run --trials on flat ground and in each cell of Table II, with --compare"""
    out: Path | None = None
    """results, .json"""
    film: Path | None = None
    """film of the first trial, .mp4"""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a mistake in it is one line and exit code 2."""
    with cli.one_line_errors(arguments):
        options = cli.parse(Options, arguments, "sim2sim")
        jax_setup.prepare()
        if options.film and options.table:
            raise ConfigError("--film goes with one --kind, not with --table")
        if options.film:
            cli.prepare_output(options.film, ".mp4", "--film")
        if options.out:
            cli.prepare_output(options.out, ".json")
        path = sources.find_policy(options.policy or sources.bundled_policy())
        sources.check_robot(path, options.robot)
        policy = reader.read(path)
        print(sources.describe(path, policy), flush=True)
        physics = build_world(policy.config, "mujoco").physics
        record = (_run_table if options.table else _run_kind)(policy, path, physics, options)
        if options.out:
            options.out.write_text(json.dumps(record, indent=2) + "\n")


def _run_kind(
    policy: TrainedPolicy, path: Path, physics: Physics, options: Options
) -> dict[str, Any]:
    """Run, print and return the trials on lanes of one kind."""
    world = crossing.crossing_world(policy.config, physics, options.kind, options.size)
    trials = run_trials(world, path, options)
    result = summarize(trials, options)
    print(f"whole robot, MuJoCo C, numpy: {result.line()}")
    said = Counter(flag.name for trial in trials for flag in deploy.Status if flag & trial.status)
    if said:
        print("status of the policy: " + ", ".join(f"{k} in {n} trials" for k, n in said.items()))
        if deploy.Status.NO_DEPTH.name in said:
            print("NO_DEPTH: before the first frame, as at every start, or because none came")
    record = {"stand_in": result._asdict(), "status": said}
    if options.compare:
        theirs = run_in_training(policy, physics, options)
        print(f"training simulation, JAX:   {theirs.line()}")
        record["training"] = theirs._asdict()
    if options.film:
        _film(options.film, world, trials[0])
        print(f"wrote {options.film}")
    return record


def _run_table(
    policy: TrainedPolicy, path: Path, physics: Physics, options: Options
) -> dict[str, Any]:
    """Run, print and return the trials on flat ground and in each cell."""
    cells: list[sim2sim_table.CellComparison] = []
    asked = sim2sim_table.list_lanes()
    for name, lanes in asked.items():
        print(f"cell {len(cells) + 1} of {len(asked)}, {name}", flush=True)
        ours, theirs = [], []
        for kind, size in lanes:
            count = max(1, options.trials // len(lanes))
            on = dataclasses.replace(options, kind=kind, size=size, trials=count)
            world = crossing.crossing_world(policy.config, physics, kind, size)
            ours.append(summarize(run_trials(world, path, on), on))
            theirs.append(run_in_training(policy, physics, on))
        cells.append(sim2sim_table.CellComparison(name, tuple(theirs), tuple(ours)))
        print(cells[-1].line(), flush=True)
    cli.print_table(sim2sim_table.to_table(cells))
    asdict = lambda crossings: [c._asdict() for c in crossings]
    return {c.name: {"stand_in": asdict(c.stand_in), "training": asdict(c.training)} for c in cells}


def run_in_training(policy: TrainedPolicy, physics: Physics, options: Options) -> LaneResult:
    """Run the same trials in the training simulation."""
    return crossing.cross(
        policy.config, physics, policy.train, options.kind, options.size, options.trials,
        options.seed, randomised=options.randomised,
    )  # fmt: skip


def run_trials(world: World, path: Path, options: Options) -> list[Trial]:
    """Run the trials on all cores."""
    lanes = [to_lane(world, level) for level in range(world.lanes.levels)]
    _, levels = crossing.crossing_lanes(options.trials)
    starts = initial_states(world, options.seed, options.trials)
    jobs = list(zip(starts, levels.tolist(), range(options.trials), strict=True))
    return parallel.run(_Walker, (world.config, path, lanes, options), jobs)


class _Walker:
    """Runs trials of one policy; policy and models are built once."""

    def __init__(self, c: Config, path: Path, lanes: list[Lane], options: Options) -> None:
        self._contents = deploy.contents(path)
        joints = deploy.Policy(*self._contents).joints.names
        self._bodies = [WholeBodySim(c, lane, joints) for lane in lanes]
        self._late = max(1, round(options.latency / c.physics.control_period))
        self._config, self._options = protocol.randomise(c), options

    def __call__(self, job: tuple[Start, int, int]) -> Trial:
        start, level, number = job
        policy, body, perturbation = deploy.Policy(*self._contents), self._bodies[level], None
        disturbance = Disturbance(latency=self._late)
        if self._options.randomised:
            rng = np.random.default_rng([self._options.seed, number])
            body = body.deviate(sample_deviation(self._config, len(body.driven), rng))
            perturbation = Perturbation(self._config, rng)
            disturbance = sample_disturbance(self._config.randomisation, self._late, rng)
        return run_trial(body, policy, start, TRIAL_SECONDS, disturbance, perturbation)


def summarize(trials: list[Trial], options: Options) -> LaneResult:
    """Count how many trials came to the end, and how the others ended."""
    causes = Counter(trial.ending for trial in trials)
    seconds = [trial.seconds for trial in trials if trial.ending == "finished"]
    return LaneResult(
        kind=options.kind,
        size_m=options.size,
        trials=len(trials),
        successes=causes.pop("finished", 0),
        by_cause=dict(causes),
        seconds=float(np.mean(seconds)) if seconds else None,
        speed=float(np.mean([trial.speed for trial in trials])),
    )


def _film(out: Path, world: World, trial: Trial) -> None:
    """Film a trial."""
    c, period = world.config, world.config.physics.control_period
    stride = max(1, round(1.0 / (FRAME_RATE * period)))
    points = robot_scene.camera_path(trial.qpos, period)
    moments = range(0, len(trial.qpos), stride)
    with robot_scene.Canvas(
        robot_scene.build("all", c.physics, world.lanes.tile(0, 0), c.robot.name), *SIZE
    ) as canvas:
        frames = (canvas.draw(trial.qpos[t], points[t]) for t in track(moments, "drawing"))
        video.write_video(out, frames, 1.0 / (stride * period))


if __name__ == "__main__":
    main()
