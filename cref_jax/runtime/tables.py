"""A manifest and weights, read strictly: every key, type, shape and range is checked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


class PolicyFormatError(ValueError):
    """The files are not a policy of this format; the message is one line."""


class Weights:
    """The arrays of weights.npz, each taken once by name and shape."""

    def __init__(self, arrays: dict[str, np.ndarray], prefix: str = "") -> None:
        self._left, self._prefix = arrays, prefix

    def under(self, name: str) -> Weights:
        """Select the arrays of one part of the network."""
        return Weights(self._left, f"{self._prefix}{name}/")

    def take(self, name: str, *shape: int) -> np.ndarray:
        """Take a copy of an array, aligned in memory."""
        name = self._prefix + name
        if name not in self._left:
            raise PolicyFormatError(f"weights.npz has no '{name}'")
        array = self._left.pop(name)
        if array.dtype != np.dtype("<f4") or array.shape != shape:
            actual = f"{array.dtype}{list(array.shape)}"
            raise PolicyFormatError(f"'{name}' must be float32{list(shape)}, not {actual}")
        if not np.isfinite(array).all():
            raise PolicyFormatError(f"'{name}' has numbers that are not finite")
        return array.astype(np.float32)

    def finish(self) -> None:
        """Refuse arrays that were not taken."""
        if self._left:
            raise PolicyFormatError(f"weights.npz has an unknown '{min(self._left)}'")


class Table:
    """An object of the manifest, read key by key; every unexpected value is an error."""

    def __init__(self, value: Any, where: str) -> None:
        if not isinstance(value, dict):
            raise PolicyFormatError(f"{where} must be an object")
        self._values, self._where = value, where

    def _get(self, key: str) -> Any:
        if key not in self._values:
            raise PolicyFormatError(f"{self._where} has no '{key}'")
        return self._values[key]

    def _refuse(self, key: str, right: str) -> PolicyFormatError:
        actual = repr(self._values[key])[:60]
        return PolicyFormatError(f"{self._where}.{key} must be {right}, not {actual}")

    def table(self, key: str) -> Table:
        """Read an object."""
        return Table(self._get(key), f"{self._where}.{key}")

    def tables(self, key: str) -> list[Table]:
        """Read an array of objects."""
        where = f"{self._where}.{key}"
        return [Table(value, f"{where}[{i}]") for i, value in enumerate(self.array(key))]

    def array(self, key: str) -> list[Any]:
        """Read an array of at most 1024 values."""
        values = self._get(key)
        if not isinstance(values, list) or len(values) > 1024:
            raise self._refuse(key, "an array")
        return values

    def text(self, key: str, among: Sequence[str] = ()) -> str:
        """Read a non-empty string, one of `among` if given."""
        value = self._get(key)
        if not isinstance(value, str) or not value or (among and value not in among):
            raise self._refuse(key, f"one of {', '.join(among)}" if among else "a string")
        return value

    def real(self, key: str, low: float, high: float) -> float:
        """Read a number in [low, high]."""
        self._numbers(key, [self._get(key)], low, high)
        return float(self._values[key])

    def reals(self, key: str, count: int, low: float = -1e6) -> np.ndarray:
        """Read `count` numbers from `low` to 1e6 as f32[count]."""
        values = self._numbers(key, self.array(key), low, 1e6)
        if len(values) != count:
            raise self._refuse(key, f"{count} numbers")
        return values

    def has(self, key: str) -> bool:
        """Check whether the key exists: keys of later formats may be missing."""
        return key in self._values

    def whole(self, key: str, low: int, high: int) -> int:
        """Read an integer in [low, high]."""
        value = self._get(key)
        if type(value) is not int or not low <= value <= high:
            raise self._refuse(key, f"an integer from {low} to {high}")
        return value

    def wholes(self, key: str, low: int, high: int) -> tuple[int, ...]:
        """Read an array of integers in [low, high]."""
        values = {str(i): value for i, value in enumerate(self.array(key))}
        table = Table(values, f"{self._where}.{key}")
        return tuple(table.whole(i, low, high) for i in values)

    def _numbers(self, key: str, values: list[Any], low: float, high: float) -> np.ndarray:
        if not all(type(x) in (int, float) and low <= x <= high for x in values):
            raise self._refuse(key, f"from {low:g} to {high:g}")
        return np.array(values, np.float32)
