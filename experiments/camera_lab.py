"""Effect of the depth camera's pixel window: `python experiments/camera_lab.py`.

A camera with one ray per pixel sees salt-and-pepper noise over holes smaller than the pixel spacing
on the ground. The policy is run on scenes full of such holes, different from those of `--suite
ood`, with each pixel replaced by the nearest of 1 x 1, 3 x 3 and 5 x 5 pixels.
"""

import cref_jax.system.startup  # noqa: F401

import json
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from cref_jax import deploy
from cref_jax.evaluation import scene_suite
from cref_jax.policy import sources
from cref_jax.whole_body import scene_files

SCENES = Path(__file__).parent / "holes"


@dataclass(frozen=True)
class Options:
    """Compare windows of the depth camera, without training."""

    policy: Path | None = None
    """output of `python -m cref_jax.export` (default: the bundled policy)"""
    windows: tuple[int, ...] = (1, 3, 5)
    """window sizes in pixels, odd"""
    trials: int = 16
    """trials per scene"""
    seed: int = 0
    """random seed of starts and commands"""


def main() -> None:
    """Print the number of successful trials by scene and window."""
    options = tyro.cli(Options)
    scenes = {path.stem: scene_files.load(path) for path in sorted(SCENES.glob("*.toml"))}
    print("| window | " + " | ".join(scene.title for scene in scenes.values()) + " | all |")
    for window in options.windows:
        with tempfile.TemporaryDirectory() as folder:
            path = copy_with_window(
                sources.find_policy(options.policy or sources.bundled_policy()),
                window,
                Path(folder) / "policy",
            )
            result = scene_suite.run_scenes(path, options.trials, 0, options.seed, scenes=scenes)
        counts = [scene.successes for scene in result.scenes]
        total = f"{sum(counts)} of {len(counts) * options.trials}"
        print(
            f"| {window} x {window} | " + " | ".join(map(str, counts)) + f" | {total} |", flush=True
        )


def copy_with_window(policy: Path, window: int, out: Path) -> Path:
    """Copy an exported policy to `out` with a depth window of `window` pixels, and return `out`."""
    shutil.copytree(policy, out)
    path = out / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["depth"]["window"] = window
    manifest["digest"] = deploy.manifest_digest(manifest)
    path.write_text(json.dumps(manifest, indent=2) + "\n")
    return out


if __name__ == "__main__":
    main()
