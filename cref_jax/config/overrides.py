"""Changes to the settings: from TOML files, the command line and stored JSON."""

import dataclasses
import difflib
import math
import re
import tomllib
import types
import typing
from pathlib import Path
from typing import Any, Literal, TypeVar

from cref_jax.errors import ConfigError

C = TypeVar("C")
DEEPEST = 16  # tables within each other; no file needs more than three
TOO_DEEP = re.compile(rf"(?:\.[ \t]*[\w\"'-]+[ \t]*){{{DEEPEST}}}")
"""Keys that tomllib takes gigabytes for"""


def override(config: C, changes: Any, where: str = "") -> C:
    """Apply nested `changes` to `config`.

    Raises:
        ConfigError: a key that does not exist (the nearest one is named), or a bad value.
    """
    if not isinstance(changes, dict):
        name = f"'{where.removesuffix('.')}'" if where else "what is here"
        raise ConfigError(f"{name} is a table of settings, not {changes!r}")
    hints = typing.get_type_hints(type(config))
    values: dict[str, Any] = {}
    for key, value in changes.items():
        path = f"{where}{key}"
        if key not in hints:
            raise ConfigError(describe_unknown("setting", key, list(hints), where))
        if dataclasses.is_dataclass(hints[key]):
            values[key] = override(getattr(config, key), value, where=f"{path}.")
        else:
            values[key] = _check_value(value, hints[key], path)
    return dataclasses.replace(config, **values)  # type: ignore[type-var]


def describe_unknown(what: str, name: str, known: list[str], where: str = "") -> str:
    """Build the message for an unknown name: the nearest one, or all that exist.

    `where` is what stands before the name, such as the tables that a setting is in.
    """
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(sorted(known))}"
    return f"unknown {what} '{where}{name}'; {hint}"


def load_toml(path: Path) -> dict[str, Any]:
    """Read the tables of a TOML file.

    Raises:
        ConfigError: the file is missing or is not TOML.
    """
    try:
        text = path.read_text(encoding="utf-8")
        if TOO_DEEP.search(text):
            raise ConfigError(f"{path}: more than {DEEPEST} tables within each other")
        return tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"{path}: too many tables or lists within each other") from None
    except FileNotFoundError:
        raise ConfigError(f"no file {path}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise ConfigError(f"{path}: {error}") from None


def check_finite(value: Any, where: str) -> None:
    """Refuse NaN and infinity anywhere in a table.

    Raises:
        ConfigError: there is one.
    """
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            check_finite(inner, where)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{where}: every number must be finite, not {value}")


def _check_value(value: Any, hint: Any, path: str) -> Any:
    """Convert `value` to the field's declared type, or say what would be right."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        inner = next(arg for arg in args if arg is not type(None))
        return None if value is None else _check_value(value, inner, path)
    if origin is Literal:
        if value not in args:
            raise ConfigError(
                f"'{path}' must be one of {', '.join(map(repr, args))}, not {value!r}"
            )
        return value
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigError(f"'{path}' must be a list, not {value!r}")
        kinds = [args[0]] * len(value) if args[-1] is Ellipsis else list(args)
        if len(kinds) != len(value):
            raise ConfigError(f"'{path}' takes {len(kinds)} values, not {len(value)}")
        return tuple(_check_value(v, k, path) for v, k in zip(value, kinds, strict=True))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not hint:
        raise ConfigError(f"'{path}' must be {hint.__name__}, not {value!r}")
    return value
