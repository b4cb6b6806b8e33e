"""The way of the data goes in one direction, and no file or function grows without a limit."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "cref_jax"
FILES = sorted(PACKAGE.glob("**/*.py"))
NAMES = [path.stem for path in FILES if path.stem != "__init__"]

LAYERS = [
    {
        "config",
        "geometry",
        "gaussian",
        "readout",
        "deploy",
        "leaves",
        "recurrent",
        "kernels",
        "hlo",
    },
    {
        "paper",
        "limits",
        "ramp",
        "gait",
        "losses",
        "sideways",
        "proportion",
        "stall",
        "disturbance",
        "processes",
        "layers",
        "patches",
        "holding",
    },
    {"terrain", "shapes", "robot", "host_call", "film", "page", "curves"},
    {"kinematics", "lanes", "march", "host_physics", "outcomes", "learning_charts", "profile"},
    {"evaluation_tables"},
    {"device_physics"},
    {"physics", "depth", "foothold", "evaluation_page"},
    {"world", "observation", "reward"},
    {"episode"},
    {"env", "network", "ppo"},
    {"rollout", "checkpoint", "distill", "brax_env", "gaze", "mirror"},
    {"trials"},
    {"learn", "evaluation", "cli", "progress", "scene", "panel", "vectors"},
    {"commands", "runs", "stages", "stand_in", "table", "run_page", "ood"},
    {"learner", "robustness"},
    {"exported", "ood_verdict", "transfer", "peers", "brax_peer"},
    {"watch", "ood_suite", "roofline"},
    {"train", "eval", "play", "bench", "gpu_program", "params", "export", "sim2sim", "report"},
]
RANK = {name: rank for rank, layer in enumerate(LAYERS) for name in layer}


def tree(name: str) -> ast.Module:
    return ast.parse((PACKAGE / f"{name}.py").read_text(encoding="utf-8"))


def imports(module: ast.Module) -> set[str]:
    """Return every dotted name that is imported anywhere in the file, inside functions as well."""
    found = set()
    for node in ast.walk(module):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def siblings(name: str) -> set[str]:
    """Return the modules of the package that `name` imports."""
    parts = [dotted.split(".") for dotted in imports(tree(name))]
    return {part[1] for part in parts if part[0] == "cref_jax" and part[1:2] and part[1] in NAMES}


def test_the_table_knows_every_module():
    assert sorted(set(NAMES) - set(RANK)) == []


def test_the_package_is_flat():
    assert [path for path in FILES if path.parent != PACKAGE] == []


@pytest.mark.parametrize("name", NAMES)
def test_a_module_imports_only_from_lower_layers(name):
    assert {other for other in siblings(name) if RANK[other] >= RANK[name]} == set()


def test_only_device_physics_touches_mjx():
    users = [name for name in NAMES if any("mjx" in i.split(".") for i in imports(tree(name)))]
    assert users == ["device_physics"]


def test_the_package_itself_is_only_a_docstring():
    body = tree("__init__").body
    assert len(body) == 1 and isinstance(body[0], ast.Expr)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_no_file_is_longer_than_400_lines(path):
    most = 1050 if path.stem == "deploy" else 400  # it goes to the robot alone, so it is one file
    assert len(path.read_text(encoding="utf-8").splitlines()) <= most


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_no_function_is_longer_than_50_lines(path):
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    functions = [node for node in ast.walk(tree(path.stem)) if isinstance(node, kinds)]
    long = {f.name: f.end_lineno - f.lineno + 1 for f in functions if f.end_lineno - f.lineno >= 50}
    assert long == {}


def test_the_deployed_policy_needs_numpy_and_nothing_else():
    outside = {dotted.split(".")[0] for dotted in imports(tree("deploy"))}
    assert outside <= {"numpy", "__future__", *sys.stdlib_module_names}
    blocked = "import sys; sys.modules['jax'] = None; import cref_jax.deploy"
    subprocess.run([sys.executable, "-c", blocked], check=True)
