"""Judge a policy: `python -m cref_jax.eval --run runs/NAME`."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from cref_jax import cli, evaluation, exported, runs
from cref_jax.config import ConfigError
from cref_jax.physics import EngineName


@dataclass(frozen=True)
class Options:
    """Measure how a trained policy walks."""

    run: Path | None = None
    """runs/NAME; the newest one when left out, or the bundled policy where there is none"""
    policy: Path | None = None
    """an exported policy instead of a run"""
    suite: Literal["walk", "cross"] = "walk"
    """walk: episodes of 20 s on flat ground at 0.4 to 0.8 m/s; cross: trials of up to 40 s on a
    lane with obstacles of one size"""
    kind: str = "gap"
    """of the obstacles to cross: gap, stairs_up, stairs_down, platform, rough, slope"""
    size: float = 0.3
    """of the obstacles to cross, m"""
    num_envs: int = 200
    """episodes or trials"""
    seed: int = 0
    """of the first states and commands"""
    engine: EngineName = "auto"
    """mujoco steps on the CPU, mjx on the device"""
    out: Path | None = None
    """folder for eval.json; the run's own when left out, or the present one"""
    debug: bool = False
    """show the traceback of an error"""


def main() -> None:
    """Run the command line."""
    options = tyro.cli(Options, prog="python -m cref_jax.eval")
    with cli.one_line_errors(options.debug):
        cli.prepare()
        if options.num_envs < 1:
            raise ConfigError(f"--num-envs must be at least 1, not {options.num_envs}")
        source = exported.chosen(options.run, options.policy)
        world = runs.world_of(exported.read_config(source), options.engine)
        policy = exported.load(source, world)
        c, train = policy.config, policy.train
        if options.suite == "walk":
            result = evaluation.walk(c, world.physics, train, options.num_envs, options.seed)
        else:
            result = evaluation.cross(
                c, world.physics, train, options.kind, options.size, options.num_envs, options.seed
            )
        print(f"{source}, iteration {policy.iteration}: {result.line()}")
        out = options.out or (source if exported.is_run(source) else Path())
        out.mkdir(parents=True, exist_ok=True)
        record = {
            "suite": options.suite,
            "run": str(source),
            "iteration": policy.iteration,
            "seed": options.seed,
            **result._asdict(),
        }
        (out / "eval.json").write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()
