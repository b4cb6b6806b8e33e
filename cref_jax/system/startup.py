"""Environment variables that numpy and MuJoCo read at import; import this module before them.

This is the only module whose import changes the process. It uses only the standard library.
"""

import os
import sys
from ctypes.util import find_library

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")

if "numpy" not in sys.modules:  # a policy's small products are ten times slower on many threads
    for _name in THREADS:
        os.environ.setdefault(_name, "1")

if sys.platform == "linux" and not (os.getenv("DISPLAY") or os.getenv("WAYLAND_DISPLAY")):
    _gl = [name for name, file in (("egl", "EGL"), ("osmesa", "OSMesa")) if find_library(file)]
    os.environ.setdefault("MUJOCO_GL", _gl[0] if _gl else "off")
