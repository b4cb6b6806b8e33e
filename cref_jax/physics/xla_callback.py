"""Python functions as XLA custom calls, which a compiled program refers to by name alone.

`jax.pure_callback` writes the address of the function into the program, so JAX never stores such a
program in its cache on disk: half a minute of compilation at every start. A custom call is looked
up by name when the program is loaded. The structures mirror XLA's stable C interface for foreign
functions, `xla/ffi/api/c_api.h`; only a CPU can call into Python.
"""

import atexit
import contextlib
import ctypes
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Shaped

HostFunction = Callable[[list[np.ndarray], list[np.ndarray]], None]

_METADATA = 1  # type of the extension with which XLA queries the interface version
_EXECUTE = 3  # stage of a call
_INTERNAL = 13  # error code
_DTYPES = {1: np.bool_, 4: np.int32, 8: np.uint32, 11: np.float32, 12: np.float64}
_keep_alive: list[Any] = []  # handlers whose addresses XLA holds until the process ends


class _Version(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("major", ctypes.c_int),
        ("minor", ctypes.c_int),
    )


class _Api(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("version", _Version),
        ("internal", ctypes.c_void_p),
        ("error_create", ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)),
    )


class _ErrorCreate(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("message", ctypes.c_char_p),
        ("code", ctypes.c_int),
    )


class _Metadata(ctypes.Structure):
    _fields_ = (("struct_size", ctypes.c_size_t), ("version", _Version))


class _Extension(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(_Metadata)),
    )


class _Buffer(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    )


class _Buffers(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("values", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    )


class _CallFrame(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.POINTER(_Extension)),
        ("api", ctypes.POINTER(_Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("arguments", _Buffers),
        ("results", _Buffers),
    )


def register(name: str, function: HostFunction) -> None:
    """Make `function(arguments, results)` callable by `name`; call this once per process.

    It reads the arguments and fills the results, both views of XLA's own memory that must not
    outlive the call. An exception fails the calling program.
    """

    def handle(address: int) -> int:
        frame = _CallFrame.from_address(address)
        if frame.extension and frame.extension.contents.type == _METADATA:
            requested, own = frame.extension.contents.metadata.contents.version, frame.api.contents
            requested.major, requested.minor = own.version.major, own.version.minor
        elif frame.stage == _EXECUTE:
            try:
                function(_view_buffers(frame.arguments), _view_buffers(frame.results))
            except Exception as error:
                return _make_error(frame.api.contents, f"{type(error).__name__}: {error}")
        return 0

    handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(handle)
    _keep_alive.append(handler)
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform="cpu")


def call(
    name: str, results: Sequence[jax.ShapeDtypeStruct], *arguments: Shaped[Array, "..."]
) -> tuple[Shaped[Array, "..."], ...]:
    """Call the function `name`; under vmap all arrays get the batch's leading axes."""
    return tuple(jax.ffi.ffi_call(name, tuple(results), vmap_method="broadcast_all")(*arguments))


@atexit.register
def _wait_for_programs() -> None:
    """Wait for programs before the interpreter exits: a later call would hang forever."""
    arrays = []
    with contextlib.suppress(Exception):  # a machine without a device has none
        arrays = jax.live_arrays()
    for array in arrays:
        with contextlib.suppress(Exception):  # failures no longer matter at exit
            array.block_until_ready()


def _view_buffers(buffers: _Buffers) -> list[np.ndarray]:
    """Create array views of the buffers' memory."""
    views = []
    for k in range(buffers.size):
        buffer = buffers.values[k].contents
        shape = tuple(buffer.dims[axis] for axis in range(buffer.rank))
        dtype = np.dtype(_DTYPES[buffer.dtype])
        size = dtype.itemsize * math.prod(shape)
        if not size:
            views.append(np.empty(shape, dtype))
            continue
        memory = (ctypes.c_char * size).from_address(buffer.data)
        views.append(np.ndarray(shape, dtype, memory))
    return views


def _make_error(api: _Api, message: str) -> int:
    """Create XLA's own error with this message."""
    error = _ErrorCreate(ctypes.sizeof(_ErrorCreate), None, message.encode(), _INTERNAL)
    return api.error_create(ctypes.addressof(error)) or 0
