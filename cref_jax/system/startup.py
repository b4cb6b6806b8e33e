"""Environment variables that numpy and MuJoCo read at import; import this module before them.

From here on Ctrl-C ends a command, also during the seconds that the other imports take. This is the
only module whose import changes the process. It needs nothing but the standard library.
"""

import os
import sys
from ctypes.util import find_library

from cref_jax.system import interrupts

_spec = getattr(sys.modules["__main__"], "__spec__", None)
if sys.argv[0].endswith("cref") or (_spec and _spec.name.startswith("cref_jax.")):
    interrupts.end_while_loading()  # a command, not a program that imports one

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")

if "numpy" not in sys.modules:  # a policy's small products are ten times slower on many threads
    for _name in THREADS:
        os.environ.setdefault(_name, "1")

OPENGL = {"egl": "EGL", "osmesa": "OSMesa"}  # library of each way to render without a display
missing_opengl = ""  # what MUJOCO_GL asked for and this machine lacks: importing mujoco would fail

if sys.platform == "linux":
    _asked = os.environ.get("MUJOCO_GL", "").lower()
    if _asked in OPENGL and not find_library(OPENGL[_asked]):
        missing_opengl = _asked
        os.environ["MUJOCO_GL"] = "off"
    elif not (_asked or os.getenv("DISPLAY") or os.getenv("WAYLAND_DISPLAY")):
        _there = [name for name, library in OPENGL.items() if find_library(library)]
        os.environ["MUJOCO_GL"] = _there[0] if _there else "off"
