"""The settings of a new run: defaults, device preset, experiment."""

import dataclasses
from pathlib import Path

from cref_jax.config import folders, overrides
from cref_jax.config.settings import Config
from cref_jax.errors import ConfigError


def build_config(terrain: str, experiment: str | None, device: str) -> Config:
    """Build the settings of a new run: the paper's, changed by device and experiment.

    Raises:
        ConfigError: an unknown experiment, or a file that cannot be used.
    """
    c = overrides.override(Config(), {"terrain": {"name": terrain}})
    preset = overrides.load_toml(_experiment_file("presets")).get(device, {})
    for_terrain = preset.pop(terrain, {})
    known = {f.name for f in dataclasses.fields(Config)}
    c = overrides.override(c, {k: v for k, v in preset.items() if k in known})
    c = overrides.override(c, for_terrain)
    if experiment:
        c = overrides.override(c, overrides.load_toml(_experiment_file(experiment)))
    return c


def _experiment_file(name: str) -> Path:
    """Return the file of an experiment, given by its name or as a path."""
    if name.endswith(".toml"):
        return Path(name)
    folder = folders.data_folder("experiments")
    known = sorted(p.stem for p in folder.glob("*.toml") if p.stem != "presets")
    if name not in (*known, "presets"):
        raise ConfigError(overrides.describe_unknown("experiment", name, known))
    return folder / f"{name}.toml"
