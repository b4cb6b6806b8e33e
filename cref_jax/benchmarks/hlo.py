"""What a compiled program launches and moves, counted in the text of its optimised HLO.

Each instruction of a computation that no fusion has taken in is one kernel. A loop counts as often
as it turns, which XLA knows of all but a few; of the branches of a conditional the largest counts.
"""

import re
from collections.abc import Callable, Iterator
from math import prod
from typing import NamedTuple

BYTES = {"pred": 1, "s8": 1, "u8": 1, "f16": 2, "bf16": 2, "s16": 2, "u16": 2}
BYTES |= {"s32": 4, "u32": 4, "f32": 4, "s64": 8, "u64": 8, "f64": 8}
NO_KERNEL = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all"}
NO_KERNEL |= {"partition-id", "replica-id", "opt-barrier", "async-done", "copy-done"}
TAKES_A_PART = {"slice", "dynamic-slice", "gather"}  # reads of its first operand what it returns

_SHAPE = re.compile(r"\b(\w+)\[([\d,]*)\]")
_INSTRUCTION = re.compile(r"\s+(ROOT )?%?([\w.\-]+) = (\(.*?\)|\S+) ([a-z][a-z\-]*)\((.*)$")
_TABLES = ("FileNames", "FunctionNames", "FileLocations", "StackFrames")


class Instruction(NamedTuple):
    """One line of a computation."""

    name: str
    shape: str
    operation: str
    operands: tuple[str, ...]
    attributes: str  # the line from its first operand on
    is_root: bool


class Frame(NamedTuple):
    """A line of the source."""

    file: str
    function: str


class Kernel(NamedTuple):
    """A kernel of the program."""

    stack: tuple[Frame, ...]  # innermost first; empty for what XLA has added
    loop: tuple[Frame, ...]  # of the loop around it
    operation: str  # or the name of the library's function
    times: float  # how often it is launched
    bytes: int  # read and written by one launch
    flops: int  # of one launch's matrix products


class Program:
    """A compiled program."""

    def __init__(self, text: str) -> None:
        self._computations: dict[str, dict[str, Instruction]] = {}
        self._tables: dict[str, dict[int, str]] = {name: {} for name in _TABLES}
        self._entry = ""
        current, table = None, None
        for line in text.splitlines():
            if line in self._tables:
                table = self._tables[line]
            elif table is not None and (row := re.match(r"(\d+) (.*)", line)):
                table[int(row[1])] = row[2]
            elif head := re.match(r"(ENTRY )?%?([\w.\-]+) .*\{$", line):
                current, table = self._computations.setdefault(head[2], {}), None
                self._entry = head[2] if head[1] else self._entry
            elif current is not None and (found := _instruction(line)):
                current[found.name] = found

    def kernels(self, turns: Callable[[tuple[Frame, ...]], float]) -> Iterator[Kernel]:
        """Yield every kernel.

        `turns` says, from its stack, how often a loop turns whose number XLA does not know, and in
        what share of cases the largest branch of a conditional is taken.
        """
        yield from self._kernels(self._entry, 1.0, (), turns)

    def _kernels(
        self, computation: str, times: float, loop: tuple[Frame, ...], turns: Callable
    ) -> Iterator[Kernel]:
        for i in self._computations[computation].values():
            if i.operation in NO_KERNEL:
                continue
            stack = self._stack(i)
            if i.operation == "while":
                known = re.search(r'known_trip_count":\{"n":"(\d+)"', i.attributes)
                count = float(known[1]) if known else turns(stack)
                yield from self._kernels(_called(i, "body"), times * count, stack, turns)
            elif i.operation == "conditional":
                branches = [x for x in _names(i.attributes) if x in self._computations]
                largest = max(branches, key=lambda name: len(self._computations[name]))
                yield from self._kernels(largest, times * turns(stack), stack or loop, turns)
            elif i.operation in ("call", "async-start"):
                inner = _called(i, "to_apply") or _called(i, "calls")
                yield from self._kernels(inner, times, loop, turns)
            else:
                moved, flops = self._traffic(computation, i), self._flops(computation, i)
                library = re.search(r'custom_call_target="([^"]+)"', i.attributes)
                name = library[1] if library else i.operation
                yield Kernel(stack, loop, name, times, moved, flops)

    def _stack(self, i: Instruction) -> tuple[Frame, ...]:
        """Return the lines of the source that an instruction comes from, innermost first."""
        number = _number("stack_frame_id", i.attributes)
        if not number and i.operation == "fusion":  # then it is that of a part
            inside = self._computations[_called(i, "calls")].values()
            number = next((n for j in inside if (n := _number("stack_frame_id", j.attributes))), 0)
        found = []
        while number in self._tables["StackFrames"]:
            frame = self._tables["StackFrames"][number]
            place = self._tables["FileLocations"][_number("file_location_id", frame)]
            file = self._tables["FileNames"][_number("file_name_id", place)].strip('"')
            function = self._tables["FunctionNames"][_number("function_name_id", place)].strip('"')
            found.append(Frame(file, function))
            number = _number("parent_frame_id", frame) - 1  # it is printed one higher
        return tuple(found)

    def _flops(self, computation: str, i: Instruction) -> int:
        """Return the work of the matrix products in one instruction."""
        if i.operation == "fusion":
            inner = _called(i, "calls")
            return sum(self._flops(inner, j) for j in self._computations[inner].values())
        if i.operation != "dot":
            return 0
        left = _shapes(self._computations[computation][i.operands[0]].shape)[0][1]
        summed = re.search(r"lhs_contracting_dims=\{([\d,]*)\}", i.attributes)
        depth = prod(left[int(k)] for k in summed[1].split(",") if k) if summed else 1
        return 2 * prod(_shapes(i.shape)[0][1]) * depth

    def _traffic(self, computation: str, i: Instruction) -> int:
        """Return the bytes that one kernel reads and writes."""
        here = self._computations[computation]
        if i.operation in TAKES_A_PART:
            return 2 * _bytes(i.shape)
        if i.operation == "dynamic-update-slice":
            return 2 * _bytes(here[i.operands[1]].shape)
        if i.operation != "fusion":
            return _bytes(i.shape) + sum(_bytes(here[o].shape) for o in i.operands if o in here)
        inside = self._computations[_called(i, "calls")]
        read = sum(_read(inside, j) for j in inside.values() if j.operation == "parameter")
        root = next(j for j in inside.values() if j.is_root)
        outputs = root.operands if root.operation == "tuple" else (root.name,)
        return read + sum(_written(inside, name) for name in outputs)


def _instruction(line: str) -> Instruction | None:
    """Return what a line of a computation says."""
    found = _INSTRUCTION.match(line)
    if found is None:
        return None
    root, name, shape, operation, rest = found.groups()
    operands = () if operation == "constant" else tuple(_names(rest.split(")", 1)[0]))
    return Instruction(name, shape, operation, operands, rest, root is not None)


def _read(inside: dict[str, Instruction], parameter: Instruction) -> int:
    """Return the bytes that a fusion reads of a parameter; of a sliced one, what is taken."""
    whole, taken, seen = _bytes(parameter.shape), 0, [parameter.name]
    for name in seen:
        for user in (j for j in inside.values() if name in j.operands):
            if user.operation == "bitcast":
                seen.append(user.name)
            elif user.operation in TAKES_A_PART and user.operands[0] == name:
                taken += _bytes(user.shape)
            elif user.operation != "dynamic-update-slice" or user.operands[0] != name:
                return whole
    return min(taken, whole)


def _written(inside: dict[str, Instruction], name: str) -> int:
    """Return the bytes that a fusion writes for an output; of an updated one, what is put in."""
    output = inside[name]
    while output.operation == "bitcast":
        output = inside[output.operands[0]]
    if output.operation == "dynamic-update-slice":
        return _bytes(inside[output.operands[1]].shape)
    return _bytes(output.shape)


def _called(i: Instruction, key: str) -> str:
    """Return the computation that an instruction calls as its `key`, or an empty name."""
    found = re.search(rf"\b{key}=%?([\w.\-]+)", i.attributes)
    return found[1] if found else ""


def _names(text: str) -> list[str]:
    return re.findall(r"%([\w.\-]+)", text)


def _number(key: str, text: str) -> int:
    found = re.search(rf"\b{key}=(\d+)", text)
    return int(found[1]) if found else 0


def _shapes(text: str) -> list[tuple[int, list[int]]]:
    """Return the bytes of an element and the sizes of each array in a type."""
    found = [(BYTES[kind], sizes) for kind, sizes in _SHAPE.findall(text) if kind in BYTES]
    return [(size, [int(n) for n in sizes.split(",") if n]) for size, sizes in found]


def _bytes(text: str) -> int:
    return sum(size * prod(sizes) for size, sizes in _shapes(text))
