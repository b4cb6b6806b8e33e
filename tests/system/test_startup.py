"""What importing startup sets, in a process of its own."""

import json
import os
import subprocess
import sys

import pytest

SHOW = """
import ctypes.util, json, os, sys
ctypes.util.find_library = lambda name: name if name in sys.argv[1:] else None
from cref_jax.system import startup
keys = ("MUJOCO_GL", "OMP_NUM_THREADS")
print(json.dumps([*(os.environ.get(key) for key in keys), startup.missing_opengl]))
"""


def started(libraries, **changes):
    bare = {
        k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY", "OMP_NUM_THREADS")
    }
    command = [sys.executable, "-c", SHOW, *libraries]
    done = subprocess.run(command, env=bare | changes, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere MuJoCo has its own way to draw")
@pytest.mark.parametrize(
    ("libraries", "changes", "expected"),
    [
        (["EGL", "OSMesa"], {}, ["egl", "1", ""]),
        (["OSMesa"], {}, ["osmesa", "1", ""]),
        ([], {}, ["off", "1", ""]),
        ([], {"DISPLAY": ":0"}, [None, "1", ""]),  # MuJoCo draws into a window
        (["EGL"], {"MUJOCO_GL": "osmesa"}, ["off", "1", "osmesa"]),  # mujoco could not be imported
        (["EGL"], {"MUJOCO_GL": "egl", "OMP_NUM_THREADS": "3"}, ["egl", "3", ""]),
    ],
)
def test_opengl_is_one_that_is_there_and_numpy_has_one_thread(libraries, changes, expected):
    assert started(libraries, **changes) == expected


INTERRUPT = """
import os, runpy, signal, sys
class Finder:
    def find_spec(self, name, *_):
        if name == os.environ["DURING"]:
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt:
                pass  # as in a callback of the garbage collector
sys.meta_path.insert(0, Finder())
module, *sys.argv[1:] = sys.argv[1:]
runpy.run_module(module, run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize(
    ("words", "during"),
    [
        (["cref_jax", "params"], "tyro"),
        (["cref_jax", "params"], "cref_jax.training.parameter_count"),
        (["cref_jax.play"], "jax"),
        (["cref_jax.train"], "tyro"),
    ],
)
def test_ctrl_c_while_a_command_is_loaded_is_one_line(words, during):
    command = [sys.executable, "-c", INTERRUPT, *words]
    changed = os.environ | {"DURING": during}
    done = subprocess.run(command, capture_output=True, text=True, env=changed)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


def test_a_program_that_imports_a_command_keeps_its_own_traceback():
    program = INTERRUPT.replace("runpy.run_module(", "__import__(module) #")
    command = [sys.executable, "-c", program, "cref_jax.params"]
    changed = os.environ | {"DURING": "tyro"}
    done = subprocess.run(command, capture_output=True, text=True, env=changed)
    assert (done.returncode, done.stderr) == (0, "")
