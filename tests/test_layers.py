"""The way of the data goes in one direction, and no file or function grows without a limit."""

import ast
import itertools
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import pytest

from cref_jax.policy.runtime_file import join_files
from cref_jax.robot.registry import ROBOTS

PACKAGE = Path(__file__).parents[1] / "cref_jax"
FILES = sorted(PACKAGE.glob("**/*.py"))


FLOORS = [
    {"errors", "geometry", "geoms", "runtime", "system"},
    {"config", "deploy"},
    {"cli", "robot", "terrain", "network", "ppo"},
    {"physics", "depth", "rendering", "pages"},
    {"env"},
    {"training", "whole_body"},
    {"policy", "benchmarks"},
    {"evaluation"},
    {"live", "reproduction"},
]

WALLS = [  # a room, what it may not reach through any number of imports, and why
    ("ppo", ("env", "robot", "physics", "terrain", "brax"), "PPO knows nothing of robots"),
    ("network", ("env", "robot", "physics", "ppo"), "a network is a function of its inputs"),
    ("env", ("ppo", "network", "training"), "the environment knows no learner"),
    (
        "whole_body",
        ("jax", "flax", "rendering", "terrain"),
        "it is an oracle of its own, and light",
    ),
    ("pages", ("env", "training", "ppo"), "a page is made of records"),
]


def dotted(path: Path) -> str:
    """Return the module's name within the package, such as `terrain.lanes`."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {dotted(path): path for path in FILES}


MAIN = 'if __name__ == "__main__":'
COMMANDS = {name for name, path in MODULES.items() if MAIN in path.read_text()} - {"deploy"}
FLOOR = {name: number for number, floor in enumerate([*FLOORS, COMMANDS]) for name in floor}


def tree(name: str) -> ast.Module:
    return ast.parse(MODULES[name].read_text(encoding="utf-8"))


def imports(module: ast.Module) -> set[str]:
    """Return every dotted name that is imported anywhere in the file, inside functions as well."""
    result = set()
    for node in ast.walk(module):
        if isinstance(node, ast.Import):
            result |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            result |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return result


def siblings(name: str) -> set[str]:
    """Return the modules of the package that `name` imports, not the package it stands in."""
    inside = {i.removeprefix("cref_jax.") for i in imports(tree(name)) if i.startswith("cref_jax.")}
    own = {name, name.rpartition(".")[0]}
    return {other for other in inside if other in MODULES} - own


def reachable(start: str) -> set[str]:
    """Return the modules that `start` imports, directly or through others."""
    result, left = set(), [start]
    while left:
        new = siblings(left.pop()) - result
        result |= new
        left += new
    return result


@pytest.mark.parametrize("name", MODULES)
def test_no_module_imports_itself_through_others(name):
    assert name not in reachable(name)


def room(name: str) -> str:
    """Return the folder of a module, or the module itself where it stands at the top."""
    return name.partition(".")[0]


def test_every_room_has_a_floor():
    assert {room(name) for name in MODULES} - {""} == set(FLOOR)


@pytest.mark.parametrize("name", [name for name in MODULES if name])
def test_a_room_imports_only_from_lower_floors(name):
    own = room(name)
    others = {room(other) for other in siblings(name)} - {own, ""}
    assert {other for other in others if FLOOR[other] >= FLOOR[own]} == set()


@pytest.mark.parametrize("room_name, forbidden, why", WALLS)
def test_walls(room_name, forbidden, why):
    inside = [name for name in MODULES if room(name) == room_name]
    assert inside
    for name in inside:
        seen = reachable(name) | {name}
        used = {room(other) for other in seen} & set(forbidden)
        outside = {i.partition(".")[0] for other in seen for i in imports(tree(other))}
        assert used | outside & set(forbidden) == set(), f"{name}: {why}"


def test_only_one_file_touches_mjx():
    users = [name for name in MODULES if any("mjx" in i.split(".") for i in imports(tree(name)))]
    assert users == ["physics.mjx_engine"]


def test_only_the_robots_room_names_a_robot_a_joint_or_a_body():
    models = [mujoco.MjSpec.from_file(str(robot.xml)) for robot in ROBOTS.values()]
    parts = [[*m.bodies, *m.joints, *m.geoms, *m.sites] for m in models]
    names = {part.name for part in itertools.chain(*parts)} - {"", "world"}
    names |= {*ROBOTS, *(robot.title for robot in ROBOTS.values())}
    assert "left_knee_joint" in names
    for name in (name for name in MODULES if room(name) != "robot"):
        constants = {n.value for n in ast.walk(tree(name)) if isinstance(n, ast.Constant)}
        assert constants & names == set(), name


def test_only_startup_changes_the_environment_when_it_is_imported():
    changes = []
    for name in MODULES:
        top = [n for n in tree(name).body if not isinstance(n, (ast.FunctionDef, ast.ClassDef))]
        text = "".join(ast.unparse(n) for n in top)
        if "os.environ.setdefault" in text or "os.environ[" in text:
            changes.append(name)
    assert changes == ["runtime.threads", "system.startup"]  # the runtime stands alone on the robot


def test_importing_the_package_leaves_jax_unused():
    """Or devices could not be chosen any more: training would have one core of all."""
    every = "; ".join(f"import cref_jax.{name}" for name in MODULES if name)
    unused = "import jax; jax.config.update('jax_num_cpu_devices', 3)"
    code = f"{every}; {unused}; assert jax.device_count() == 3"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)


def test_the_package_itself_is_only_a_docstring():
    body = tree("").body
    assert len(body) == 1 and isinstance(body[0], ast.Expr)


@pytest.mark.parametrize("path", FILES, ids=dotted)
def test_no_file_is_longer_than_400_lines(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400


@pytest.mark.parametrize("path", FILES, ids=dotted)
def test_no_function_is_longer_than_50_lines(path):
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    functions = [node for node in ast.walk(tree(dotted(path))) if isinstance(node, kinds)]
    long = {f.name: f.end_lineno - f.lineno + 1 for f in functions if f.end_lineno - f.lineno >= 50}
    assert long == {}


def test_the_deployed_policy_needs_numpy_and_nothing_else():
    outside = {dotted.split(".")[0] for dotted in imports(ast.parse(join_files()))}
    assert outside <= {"numpy", "__future__", *sys.stdlib_module_names}


@pytest.mark.parametrize("module", ["deploy", "whole_body.trial", "whole_body.scene_files"])
def test_what_runs_without_jax_does_not_load_it(module):
    blocked = f"import sys; sys.modules['jax'] = None; import cref_jax.{module}"
    subprocess.run([sys.executable, "-c", blocked], check=True)
