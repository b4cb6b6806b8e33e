"""The settings of a new run: defaults, device preset, experiment."""

import dataclasses
from pathlib import Path
from typing import Any

from cref_jax.config import folders, overrides
from cref_jax.config.limits import RANGES
from cref_jax.config.ranges import check_ranges
from cref_jax.config.settings import Config
from cref_jax.errors import ConfigError


def build_config(terrain: str, experiment: str | None, device: str) -> Config:
    """Build the settings of a new run: the defaults, changed by device and experiment.

    Raises:
        ConfigError: an unknown experiment, or a file that cannot be used.
    """
    c = overrides.override(Config(), {"terrain": {"name": terrain}})
    presets = experiment_file("presets")
    preset = overrides.load_toml(presets).get(device, {})
    for_terrain = preset.pop(terrain, {})
    known = {f.name for f in dataclasses.fields(Config)}
    c = apply_table(c, {k: v for k, v in preset.items() if k in known}, presets)
    c = apply_table(c, for_terrain, presets)
    return apply_file(c, experiment) if experiment else c


def apply_file(c: Config, experiment: str) -> Config:
    """Apply the settings of an experiment, given by its name or as a path.

    Raises:
        ConfigError: there is no such experiment, or its file cannot be used.
    """
    file = experiment_file(experiment)
    return apply_table(c, overrides.load_toml(file), file)


def apply_table(c: Config, table: Any, file: Path) -> Config:
    """Apply the settings of a file, and check their types and ranges.

    Raises:
        ConfigError: names the file, the setting and what is wrong with it.
    """
    try:
        c = overrides.override(c, table)
        check_ranges(c, RANGES)
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from None
    return c


def experiment_file(name: str) -> Path:
    """Return the file of an experiment, given by its name or as a path."""
    if name.endswith(".toml"):
        return Path(name)
    folder = folders.data_folder("experiments")
    known = sorted(p.stem for p in folder.glob("*.toml") if p.stem != "presets")
    if name not in (*known, "presets"):
        raise ConfigError(overrides.describe_unknown("experiment", name, known))
    return folder / f"{name}.toml"
