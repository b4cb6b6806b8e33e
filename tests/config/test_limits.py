"""Every number of every setting has a range, which takes what is reasonable and no more."""

import dataclasses
import json
import math
import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cref_jax import config, robot
from cref_jax.config import Config, folders, limits, presets
from cref_jax.config.ranges import Rising, Samples, Within, check_ranges
from cref_jax.errors import ConfigError
from cref_jax.policy import sources
from cref_jax.training import run_dir

EXPERIMENTS = sorted(p.stem for p in folders.data_folder("experiments").glob("*.toml"))


def numbers_of(settings: type, where: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield the path of every setting that holds numbers."""
    for name, hint in typing.get_type_hints(settings).items():
        if dataclasses.is_dataclass(hint):
            yield from numbers_of(hint, (*where, name))
        elif holds_numbers(hint):
            yield (*where, name)


def holds_numbers(hint: Any) -> bool:
    return hint in (int, float) or any(map(holds_numbers, typing.get_args(hint)))


def ranges_of(table: limits.Ranges, where: tuple[str, ...] = ()) -> dict[tuple[str, ...], Within]:
    """Return every range by the path of its setting."""
    found = {}
    for name, part in table.items():
        path = (*where, name)
        found |= {path: part} if isinstance(part, Within) else ranges_of(part, path)
    return found


RANGES = ranges_of(limits.RANGES)


def with_value(c: Any, path: tuple[str, ...], value: Any) -> Any:
    """Return the settings with one value replaced, whatever it is."""
    name, *rest = path
    return dataclasses.replace(
        c, **{name: with_value(getattr(c, name), tuple(rest), value) if rest else value}
    )


def default_of(path: tuple[str, ...]) -> Any:
    value: Any = robot.fill_in(Config())
    for name in path:
        value = getattr(value, name)
    return value


def put(value: Any, number: float) -> Any:
    """Return the value with its first number, or the first one within it, replaced."""
    return (put(value[0], number), *value[1:]) if isinstance(value, tuple) else number


def outside(path: tuple[str, ...]) -> list[Any]:
    """Return values just outside the range of a setting, and what is no number."""
    allowed, value = RANGES[path], default_of(path)
    is_whole = isinstance(put((value,), 0) and first(value), int)
    low = allowed.low - 1 if is_whole else math.nextafter(allowed.low, -math.inf)
    high = allowed.high + 1 if is_whole else math.nextafter(allowed.high, math.inf)
    wrong = [low, high] + ([] if is_whole else [math.nan, math.inf, -math.inf])
    return [put(value, number) for number in wrong]


def first(value: Any) -> Any:
    return first(value[0]) if isinstance(value, tuple) else value


def test_every_number_has_a_range_and_every_range_a_number():
    assert list(RANGES) == list(numbers_of(Config))


@pytest.mark.parametrize("path", RANGES, ids=".".join)
def test_a_value_just_outside_is_refused_by_name(path):
    option = "--" + ".".join(path).replace("_", "-")
    for value in outside(path):
        with pytest.raises(ConfigError, match=f"^{option} must be .*, not ") as error:
            limits.check(with_value(Config(), path, value))
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("path", RANGES, ids=".".join)
def test_the_ends_of_a_range_are_within(path):
    allowed, value = RANGES[path], default_of(path)
    for end in (allowed.low, allowed.high):
        if isinstance(allowed, Samples):
            assert allowed.allows((end, end, 1)) and not allowed.allows((end, end, 0))
        elif isinstance(allowed, Rising):
            assert allowed.allows((end, end))
        else:
            assert allowed.allows(put(value, end))


def test_from_is_not_above_to():
    assert Rising(0, 1).allows((0.5, 0.5)) and not Rising(0, 1).allows((0.6, 0.5))
    assert Samples(0, 1).allows((0.0, 1.0, 1000))
    assert not Samples(0, 1).allows((1.0, 0.0, 9)) and not Samples(0, 1).allows((0.0, 1.0, 1001))


def test_all_that_is_wrong_is_said_at_once():
    wrong = config.override(Config(), {"ppo": {"gamma": 1.5, "epochs": 0}})
    says = "--ppo.epochs must be 1 to 100, not 0; --ppo.gamma must be 0 to 1, not 1.5"
    with pytest.raises(ConfigError, match=f"^{re.escape(says)}$"):
        check_ranges(wrong, limits.RANGES)


@pytest.mark.parametrize("device", ["cpu", "gpu"])
@pytest.mark.parametrize("experiment", [None, *EXPERIMENTS])
def test_all_presets_and_experiments_are_within(device, experiment):
    if experiment != "presets":
        for terrain in ("flat", "gap", "mixed"):
            limits.check(presets.build_config(terrain, experiment, device))


@pytest.mark.parametrize("name", ["combined", "mixed", "robust"])
def test_the_bundled_policies_are_within(name):
    limits.check(sources.read_config(sources.bundled_policy(name)))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[ppo]\ngamma = nan\n", "mine.toml: --ppo.gamma must be 0 to 1, not nan"),
        ("[ppo]\nlearning_rate = inf\n", "--ppo.learning-rate must be 1e-08 to 1, not inf"),
        ('[ppo]\ngamma = "a"\n', "mine.toml: 'ppo.gamma' must be float, not 'a'"),
        ("ppo = 3\n", "mine.toml: 'ppo' is a table of settings, not 3"),
        ("a" + ".a" * 100_000 + " = 1\n", "mine.toml: more than 16 tables within each other"),
        ("a = " + "[" * 100_000, "mine.toml: too many tables or lists within each other"),
    ],
)
def test_an_experiment_that_cannot_be_used_is_named(tmp_path: Path, text: str, says: str):
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(ConfigError, match=re.escape(says)):
        presets.build_config("flat", str(tmp_path / "mine.toml"), "cpu")


@pytest.mark.parametrize(
    ("stored", "says"),
    [
        ({"ppo": {"gamma": 1.5}}, "config.json: --ppo.gamma must be 0 to 1, not 1.5"),
        ({"ppo": {"gamma": math.nan}}, "config.json: --ppo.gamma must be 0 to 1, not nan"),
        ([1], "config.json: what is here is a table of settings, not [1]"),
    ],
)
def test_the_settings_of_a_run_are_checked(tmp_path: Path, stored: Any, says: str):
    (tmp_path / "config.json").write_text(json.dumps(stored))
    with pytest.raises(ConfigError, match=re.escape(says)):
        run_dir.read_config(tmp_path)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"ppo": {"learning_rate": 0.1}}, "within --ppo.learning-rate-range, 1e-05 to 0.01"),
        ({"physics": {"substeps": 100}}, "must be 0.001 to 0.1 s, not 0.5"),
        ({"randomisation": {"action_delay": 0.03}}, "at most a control step, 0.02 s, not 0.03"),
        (
            {"randomisation": {"undisturbed": 0.6, "pushed_alone": 0.5}},
            "must be 1 together at most, not 0.6 and 0.5",
        ),
        ({"foothold": {"window": [61, 5]}}, "--foothold.window, 61 5, must be at most as long and"),
        ({"foothold": {"window": [12, 4]}}, "exactly as wide as --foothold.points, 60 5"),
        ({"foothold": {"min_points": 61}}, "at most the 60 of --foothold.window, not 61"),
        ({"camera": {"window": 2}}, "--camera.window must be 1, 3, 5, ..., not 2"),
        ({"network": {"convolutions": []}}, "--network.convolutions must have a layer"),
    ],
)
def test_settings_that_do_not_go_together_are_refused(changes: dict, says: str):
    with pytest.raises(ConfigError, match=re.escape(says)):
        limits.check(config.override(Config(), changes))
