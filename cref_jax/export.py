"""Write a policy for the robot: `python -m cref_jax.export --run runs/NAME --out policy/`."""

import cref_jax.system.startup  # noqa: F401

import shlex
from dataclasses import dataclass
from pathlib import Path

from cref_jax import cli, deploy
from cref_jax.env.world import build_world
from cref_jax.errors import ConfigError
from cref_jax.policy import learner_file, sources, trained, writer
from cref_jax.system import jax_setup
from cref_jax.training import run_dir


@dataclass(frozen=True)
class Options(cli.PolicyOptions):
    """Write a trained policy as a directory that runs with numpy alone, or in C."""

    run: Path | None = None
    """runs/NAME, or a file that --learner wrote (default: the newest run)"""
    policy: Path | None = None
    """an exported policy, or a bundled one by name, to write again with this version's runtime"""
    out: Path = Path("policy")
    """directory to write; a .zip of the same name is written beside it"""
    learner: Path | None = None
    """write everything that was learned, critic and optimizer included, to this .npz instead, to
    continue elsewhere with --init"""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a mistake in it is one line and exit code 2."""
    with cli.one_line_errors(arguments):
        options = cli.parse(Options, arguments, "export")
        jax_setup.prepare()
        if not options.out.name:
            raise ConfigError(f"--out must be a folder with a name, not {options.out}")
        if options.learner and options.policy:
            raise ConfigError("--learner goes with --run: an exported policy has no critic")
        if options.learner:
            out = cli.prepare_output(options.learner, ".npz", "--learner")
            _write_learner(_resolve_run(options), out)
            return
        cli.prepare_output(options.out.with_name(options.out.name + ".zip"), ".zip")
        run_dir.check_writable(options.out)
        if options.policy:
            source = sources.resolve_policy(options.run, options.policy, options.robot)
            print(sources.summarize(source), flush=True)
            writer.copy(source, options.out)
        else:
            _export(options)
        times = deploy.self_test(options.out)
        size = sum(file.stat().st_size for file in options.out.iterdir()) / 1e6
        print(f"{options.out}: {size:.1f} MB; outputs match the trained network")
        print("\n".join(deploy.report(times)))
        program = shlex.join(["python", f"{options.out}/cref_runtime.py"])
        print(f"on the robot: {program} --selftest {shlex.quote(str(options.out))}")
        if (options.out / "cref_policy.c").is_file():
            print(f"in C: cc -std=c99 -O2 -c {shlex.quote(f'{options.out}/cref_policy.c')}")


def _export(options: Options) -> None:
    """Write the run's newest policy."""
    run = _resolve_run(options)
    from_file = learner_file.is_learner(run)
    world = build_world((learner_file if from_file else run_dir).read_config(run), "mujoco")
    print(f"exporting {run} ...", flush=True)
    policy = learner_file.read(run, world) if from_file else trained.load_policy(run, world)
    print(sources.describe(run, policy), flush=True)
    writer.write(policy, world, options.out)


def _resolve_run(options: Options) -> Path:
    """Return the run as given, or the newest one of the robot."""
    run = options.run or run_dir.newest(robot=options.robot)
    sources.check_robot(run, options.robot)
    return run


def _write_learner(run: Path, out: Path) -> None:
    """Write actor, critic and optimizer of the run."""
    world = build_world(run_dir.read_config(run), "mujoco")
    print(sources.summarize(run), flush=True)
    learner_file.write(trained.load_policy(run, world), out)
    how = shlex.join(["python", "-m", "cref_jax.train", "--init", str(out)])
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB; {how}")


if __name__ == "__main__":
    main()
