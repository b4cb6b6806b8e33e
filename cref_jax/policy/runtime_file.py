"""The runtime as one file: deploy.py and the files of `runtime` that it imports, joined.

Each file comes after those that it imports; the imports of all stand at the top, once.
"""

import ast
from pathlib import Path

import cref_jax
from cref_jax.errors import ConfigError

_OWN = "cref_jax."


def join_files() -> bytes:
    """Join the runtime's files into one that needs Python and numpy alone.

    Raises:
        ConfigError: two of the files define the same name.
    """
    modules: dict[str, ast.Module] = {}
    _collect("cref_jax.deploy", modules)
    _check_names(modules)
    first, *others = modules  # threads: before numpy
    parts = [
        f'"""{ast.get_docstring(modules["cref_jax.deploy"], clean=False)}"""',
        "from __future__ import annotations",
        _standard_imports(modules),
        _body(first, modules[first]),
        "import numpy as np",
        *(_body(name, modules[name]) for name in others),
    ]
    return ("\n\n".join(parts)).encode()


def _collect(name: str, modules: dict[str, ast.Module]) -> None:
    """Add a file after those that it imports, in the order of their imports."""
    tree = ast.parse(_text(name))
    for node in tree.body:
        for other in _imported(node):
            if other.startswith(_OWN) and other not in modules:
                _collect(other, modules)
    modules[name] = tree


def _imported(node: ast.stmt) -> list[str]:
    """List the modules that a statement imports."""
    if isinstance(node, ast.ImportFrom):
        return [node.module or ""]
    return [alias.name for alias in node.names] if isinstance(node, ast.Import) else []


def _text(name: str) -> str:
    path = name.removeprefix(_OWN).replace(".", "/") + ".py"
    return (Path(cref_jax.__file__).parent / path).read_text(encoding="utf-8")


def _standard_imports(modules: dict[str, ast.Module]) -> str:
    """Write each import of the standard library once."""
    whole, parts = set[str](), dict[str, set[str]]()
    for node in (node for tree in modules.values() for node in tree.body):
        if isinstance(node, ast.Import):
            whole |= {f"import {name}" for name in _imported(node) if not name.startswith(_OWN)}
        elif isinstance(node, ast.ImportFrom) and not (node.module or "").startswith(_OWN):
            parts.setdefault(node.module or "", set()).update(alias.name for alias in node.names)
    whole -= {"import numpy"}  # it stands after the number of threads is set
    del parts["__future__"]  # it stands before all others
    lines = [f"from {name} import {', '.join(sorted(parts[name]))}" for name in sorted(parts)]
    return "\n".join([*sorted(whole), *lines])


def _body(name: str, tree: ast.Module) -> str:
    """Cut out what follows a file's docstring and imports, with its comments."""
    lines = _text(name).splitlines()
    head = [node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))]
    start = max(node.end_lineno or 0 for node in [tree.body[0], *head])
    says = (ast.get_docstring(tree) or "").partition("\n")[0]
    title = "" if name == "cref_jax.deploy" else f"\n# {says}\n\n\n"
    return title + "\n".join(lines[start:]).strip("\n") + "\n"


def _check_names(modules: dict[str, ast.Module]) -> None:
    """Refuse a name that two files define: in one file the later would hide the earlier."""
    owner: dict[str, str] = {}
    for name, tree in modules.items():
        for node in tree.body:
            targets = node.targets if isinstance(node, ast.Assign) else [node]
            for target in targets:
                defined = getattr(target, "id", getattr(target, "name", None))
                if defined and owner.setdefault(defined, name) != name:
                    raise ConfigError(f"{name} and {owner[defined]} both define {defined}")
