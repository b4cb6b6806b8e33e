"""Ranges of numbers, and their check in any dataclass: settings, or the options of a command."""

import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from cref_jax.errors import ConfigError


@dataclass(frozen=True)
class Within:
    """Numbers from `low` to `high`, both included; in a tuple, each of them."""

    low: int | float
    high: int | float

    def allows(self, value: Any) -> bool:
        """Check a value; NaN is never allowed."""
        if isinstance(value, tuple):
            return all(self.allows(part) for part in value)
        return self._holds(value)

    def _holds(self, number: int | float) -> bool:
        return self.low <= number <= self.high

    def __str__(self) -> str:
        """Name the range, such as `0 to 1`."""
        return f"{_show(self.low)} to {_show(self.high)}"


class Rising(Within):
    """Two such numbers, the second not below the first."""

    def allows(self, value: Any) -> bool:
        """Check from, to."""
        low, high = value
        return self._holds(low) and self._holds(high) and low <= high

    def __str__(self) -> str:
        """Name the range."""
        return f"from, to, rising within {super().__str__()}"


class Samples(Within):
    """From, to, and the number of samples from one to the other."""

    MOST = 1000  # samples

    def allows(self, value: Any) -> bool:
        """Check from, to, samples."""
        low, high, count = value
        ends = self._holds(low) and self._holds(high) and low <= high
        return ends and 1 <= count <= self.MOST

    def __str__(self) -> str:
        """Name the range."""
        return f"from, to, samples: rising within {super().__str__()}, 1 to {self.MOST} samples"


Ranges = Mapping[str, "Within | Ranges"]  # by field; those of a nested dataclass are nested


def declared_ranges(options: type) -> Ranges:
    """Read the ranges that the fields of a dataclass are annotated with."""
    hints = typing.get_type_hints(options, include_extras=True)
    return {
        name: part
        for name, hint in hints.items()
        for part in typing.get_args(hint)
        if isinstance(part, Within)
    }


def check_ranges(record: Any, ranges: Ranges) -> None:
    """Check the numbers of a dataclass.

    Raises:
        ConfigError: names each option that is out of range as it is typed, its range and value.
    """
    wrong = list(_find_violations(record, ranges, "--"))
    if wrong:
        raise ConfigError("; ".join(wrong))


def _find_violations(record: Any, ranges: Ranges, where: str) -> Iterator[str]:
    for name, allowed in ranges.items():
        value, option = getattr(record, name), where + name.replace("_", "-")
        if isinstance(allowed, Mapping):
            yield from _find_violations(value, allowed, f"{option}.")
        elif value is not None and not allowed.allows(value):
            shown = " ".join(map(str, value)) if isinstance(value, tuple) else value
            yield f"{option} must be {allowed}, not {shown}"


def _show(number: int | float) -> str:
    """Format a number in full if it is whole, else briefly."""
    return f"{number:g}" if isinstance(number, float) else str(number)
