"""One thread for numpy: products this small are ten times slower on several."""

import os
import sys

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

if "numpy" not in sys.modules:
    for _name in (*ONE_THREAD, "VECLIB_MAXIMUM_THREADS"):
        os.environ.setdefault(_name, "1")
