"""How many pixels a depth value should be taken from: `python experiments/camera_lab.py`.

A camera with one ray per pixel sees salt and pepper over holes smaller than a pixel's distance on
the ground. The policy is run on scenes full of such holes, other ones than those of `--suite ood`,
with the nearest of 1 x 1, 3 x 3 and 5 x 5 pixels in place of each.
"""

import json
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from cref_jax import deploy
from cref_jax.evaluation import scene_suite
from cref_jax.policy import sources
from cref_jax.whole_body import scene_files

# isort: split

import tyro

SCENES = Path(__file__).parent / "holes"


@dataclass(frozen=True)
class Options:
    """Compare windows of the depth camera without any training."""

    policy: Path | None = None
    """what `python -m cref_jax.export` wrote; the bundled policy when left out"""
    windows: tuple[int, ...] = (1, 3, 5)
    """pixels, odd"""
    trials: int = 16
    """of each scene"""
    seed: int = 0
    """of starts and commands"""


def main() -> None:
    """Print how many trials come to the end, by scene and window."""
    options = tyro.cli(Options)
    scenes = {path.stem: scene_files.load(path) for path in sorted(SCENES.glob("*.toml"))}
    print("| window | " + " | ".join(scene.title for scene in scenes.values()) + " | all |")
    for window in options.windows:
        with tempfile.TemporaryDirectory() as folder:
            path = with_window(
                sources.find_policy(options.policy or sources.bundled_policy()),
                window,
                Path(folder) / "policy",
            )
            found = scene_suite.run_scenes(path, options.trials, 0, options.seed, scenes=scenes)
        counts = [scene.successes for scene in found.scenes]
        total = f"{sum(counts)} of {len(counts) * options.trials}"
        print(
            f"| {window} x {window} | " + " | ".join(map(str, counts)) + f" | {total} |", flush=True
        )


def with_window(policy: Path, window: int, out: Path) -> Path:
    """Return a copy of an exported policy that sees the nearest of so many pixels."""
    shutil.copytree(policy, out)
    path = out / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["depth"]["window"] = window
    manifest["digest"] = deploy.manifest_digest(manifest)
    path.write_text(json.dumps(manifest, indent=2) + "\n")
    return out


if __name__ == "__main__":
    main()
