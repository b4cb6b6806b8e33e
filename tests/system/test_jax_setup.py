"""Process-wide settings of JAX, in a process of its own."""

import os
import subprocess
import sys

NO_HOME = """
import pathlib
def nowhere(): raise RuntimeError("Could not determine home directory.")
pathlib.Path.home = nowhere
"""
SHOW = """
import jax
from cref_jax.system import jax_setup
jax_setup.prepare()
print(jax.config.jax_compilation_cache_dir, jax.device_count())
"""


def prepared(code, **changes):
    ours = ("XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR")
    bare = {k: v for k, v in os.environ.items() if k not in ours}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=bare | changes, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_a_user_without_a_home_has_no_cache_and_is_told_nothing():
    assert prepared(NO_HOME + SHOW)[0] == "None"


def test_the_cache_is_the_users_own_or_the_one_that_jax_was_given(tmp_path):
    folder, _ = prepared(SHOW, XDG_CACHE_HOME=str(tmp_path))
    assert folder == str(tmp_path / "cref_jax" / "xla") and (tmp_path / "cref_jax").is_dir()
    assert prepared(SHOW, JAX_COMPILATION_CACHE_DIR=str(tmp_path))[0] == str(tmp_path)
