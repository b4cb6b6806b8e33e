"""Kernel launches, memory traffic and products of a compiled program, from its optimised HLO text.

Each instruction outside a fusion is one kernel. The body of a loop counts once per trip; XLA knows
the trip count of all but a few loops. Of the branches of a conditional, the largest counts.
"""

import re
from collections.abc import Callable, Iterator
from math import prod
from typing import NamedTuple

BYTES = {"pred": 1, "s8": 1, "u8": 1, "f16": 2, "bf16": 2, "s16": 2, "u16": 2}
BYTES |= {"s32": 4, "u32": 4, "f32": 4, "s64": 8, "u64": 8, "f64": 8}
NO_KERNEL = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all"}
NO_KERNEL |= {"partition-id", "replica-id", "opt-barrier", "async-done", "copy-done"}
PARTIAL_READS = {"slice", "dynamic-slice", "gather"}  # read only the returned part of operand 0

_SHAPE = re.compile(r"\b(\w+)\[([\d,]*)\]")
_INSTRUCTION = re.compile(r"\s+(ROOT )?%?([\w.\-]+) = (\(.*?\)|\S+) ([a-z][a-z\-]*)\((.*)$")
_TABLES = ("FileNames", "FunctionNames", "FileLocations", "StackFrames")


class Instruction(NamedTuple):
    """One line of a computation."""

    name: str
    shape: str
    operation: str
    operands: tuple[str, ...]
    attributes: str  # the rest of the line, from the first operand
    is_root: bool


class Frame(NamedTuple):
    """One frame of a source stack."""

    file: str
    function: str


class Kernel(NamedTuple):
    """A kernel with its work per launch."""

    stack: tuple[Frame, ...]  # innermost first; empty for kernels added by XLA
    loop: tuple[Frame, ...]  # of the enclosing loop
    operation: str  # or the name of the library function
    times: float  # number of launches
    bytes: int  # read and written per launch
    flops: int  # of matrix products per launch


class Program:
    """A compiled program, parsed from its HLO text."""

    def __init__(self, text: str) -> None:
        self._computations: dict[str, dict[str, Instruction]] = {}
        self._tables: dict[str, dict[int, str]] = {name: {} for name in _TABLES}
        self._stacks: dict[int, tuple[Frame, ...]] = {}  # by the number of the innermost frame
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
            elif current is not None and (instruction := _parse_instruction(line)):
                current[instruction.name] = instruction

    def kernels(self, trip_count: Callable[[tuple[Frame, ...]], float]) -> Iterator[Kernel]:
        """Yield every kernel.

        `trip_count` maps a stack to the trip count of a loop that XLA does not know and to the
        probability of the largest branch of a conditional.
        """
        yield from self._kernels(self._entry, 1.0, (), trip_count)

    def stacks(self) -> dict[str, tuple[tuple[Frame, ...], ...]]:
        """Map the name of each instruction to its own source stack and then those of its callers.

        A computation that has several callers, such as a sum, belongs to the first.
        """
        result: dict[str, tuple[tuple[Frame, ...], ...]] = {}
        entered = {self._entry}

        def visit(computation: str, callers: tuple[tuple[Frame, ...], ...]) -> None:
            for i in self._computations[computation].values():
                result[i.name] = (self._stack(i), *callers)
                for name in _find_names(i.attributes.partition(")")[2]):
                    if name in self._computations and name not in entered:
                        entered.add(name)
                        visit(name, result[i.name])

        visit(self._entry, ())
        return result

    def _kernels(
        self, computation: str, times: float, loop: tuple[Frame, ...], trip_count: Callable
    ) -> Iterator[Kernel]:
        for i in self._computations[computation].values():
            if i.operation in NO_KERNEL:
                continue
            stack = self._stack(i)
            if i.operation == "while":
                known = re.search(r'known_trip_count":\{"n":"(\d+)"', i.attributes)
                count = float(known[1]) if known else trip_count(stack)
                yield from self._kernels(_callee(i, "body"), times * count, stack, trip_count)
            elif i.operation == "conditional":
                branches = [x for x in _find_names(i.attributes) if x in self._computations]
                largest = max(branches, key=lambda name: len(self._computations[name]))
                yield from self._kernels(
                    largest, times * trip_count(stack), stack or loop, trip_count
                )
            elif i.operation in ("call", "async-start"):
                inner = _callee(i, "to_apply") or _callee(i, "calls")
                yield from self._kernels(inner, times, loop, trip_count)
            else:
                moved, flops = self._traffic(computation, i), self._flops(computation, i)
                library = re.search(r'custom_call_target="([^"]+)"', i.attributes)
                name = library[1] if library else i.operation
                yield Kernel(stack, loop, name, times, moved, flops)

    def _stack(self, i: Instruction) -> tuple[Frame, ...]:
        """Find the source stack of an instruction, innermost frame first."""
        number = _find_id("stack_frame_id", i.attributes)
        if not number and i.operation == "fusion":  # then a fused instruction has it
            inside = self._computations[_callee(i, "calls")].values()
            number = next((n for j in inside if (n := _find_id("stack_frame_id", j.attributes))), 0)
        return self._frames(number)

    def _frames(self, number: int) -> tuple[Frame, ...]:
        """Find the stack that begins with this frame; many instructions have the same."""
        if number in self._stacks:
            return self._stacks[number]
        frames, first = [], number
        while number in self._tables["StackFrames"]:
            frame = self._tables["StackFrames"][number]
            place = self._tables["FileLocations"][_find_id("file_location_id", frame)]
            file = self._tables["FileNames"][_find_id("file_name_id", place)].strip('"')
            function = self._tables["FunctionNames"][_find_id("function_name_id", place)].strip('"')
            frames.append(Frame(file, function))
            number = _find_id("parent_frame_id", frame) - 1  # printed with an offset of 1
        self._stacks[first] = tuple(frames)
        return self._stacks[first]

    def _flops(self, computation: str, i: Instruction) -> int:
        """Count the FLOPs of the matrix products in one instruction."""
        if i.operation == "fusion":
            inner = _callee(i, "calls")
            return sum(self._flops(inner, j) for j in self._computations[inner].values())
        if i.operation != "dot":
            return 0
        left = _parse_shapes(self._computations[computation][i.operands[0]].shape)[0][1]
        summed = re.search(r"lhs_contracting_dims=\{([\d,]*)\}", i.attributes)
        depth = prod(left[int(k)] for k in summed[1].split(",") if k) if summed else 1
        return 2 * prod(_parse_shapes(i.shape)[0][1]) * depth

    def _traffic(self, computation: str, i: Instruction) -> int:
        """Count the bytes that one kernel reads and writes."""
        here = self._computations[computation]
        if i.operation in PARTIAL_READS:
            return 2 * _count_bytes(i.shape)
        if i.operation == "dynamic-update-slice":
            return 2 * _count_bytes(here[i.operands[1]].shape)
        if i.operation != "fusion":
            operands = (here[o].shape for o in i.operands if o in here)
            return _count_bytes(i.shape) + sum(map(_count_bytes, operands))
        inside = self._computations[_callee(i, "calls")]
        read = sum(_bytes_read(inside, j) for j in inside.values() if j.operation == "parameter")
        root = next(j for j in inside.values() if j.is_root)
        outputs = root.operands if root.operation == "tuple" else (root.name,)
        return read + sum(_bytes_written(inside, name) for name in outputs)


def _parse_instruction(line: str) -> Instruction | None:
    """Parse a line of a computation; None if it is not an instruction."""
    match = _INSTRUCTION.match(line)
    if match is None:
        return None
    root, name, shape, operation, rest = match.groups()
    operands = () if operation == "constant" else tuple(_find_names(rest.split(")", 1)[0]))
    return Instruction(name, shape, operation, operands, rest, root is not None)


def _bytes_read(inside: dict[str, Instruction], parameter: Instruction) -> int:
    """Count the bytes that a fusion reads of a parameter; only the slices of a sliced one."""
    whole, taken, aliases = _count_bytes(parameter.shape), 0, [parameter.name]
    for name in aliases:
        for user in (j for j in inside.values() if name in j.operands):
            if user.operation == "bitcast":
                aliases.append(user.name)
            elif user.operation in PARTIAL_READS and user.operands[0] == name:
                taken += _count_bytes(user.shape)
            elif user.operation != "dynamic-update-slice" or user.operands[0] != name:
                return whole
    return min(taken, whole)


def _bytes_written(inside: dict[str, Instruction], name: str) -> int:
    """Count the bytes that a fusion writes for an output; only the update of an updated one."""
    output = inside[name]
    while output.operation == "bitcast":
        output = inside[output.operands[0]]
    if output.operation == "dynamic-update-slice":
        return _count_bytes(inside[output.operands[1]].shape)
    return _count_bytes(output.shape)


def _callee(i: Instruction, key: str) -> str:
    """Return the name of the computation called as `key`; empty if there is none."""
    match = re.search(rf"\b{key}=%?([\w.\-]+)", i.attributes)
    return match[1] if match else ""


def _find_names(text: str) -> list[str]:
    return re.findall(r"%([\w.\-]+)", text)


def _find_id(key: str, text: str) -> int:
    match = re.search(rf"\b{key}=(\d+)", text)
    return int(match[1]) if match else 0


def _parse_shapes(text: str) -> list[tuple[int, list[int]]]:
    """Parse the bytes per element and the sizes of each array in a type."""
    arrays = [(BYTES[kind], sizes) for kind, sizes in _SHAPE.findall(text) if kind in BYTES]
    return [(size, [int(n) for n in sizes.split(",") if n]) for size, sizes in arrays]


def _count_bytes(text: str) -> int:
    return sum(size * prod(sizes) for size, sizes in _parse_shapes(text))
