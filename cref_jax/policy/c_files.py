"""The policy in C99: the files of `c/`, with the manifest's numbers and the weights as tables."""

import hashlib
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from cref_jax.errors import ConfigError
from cref_jax.runtime import camera, cross_checks, network, policy, senses
from cref_jax.runtime.status import FAULTS, STOPPING, WHY, Status

NAMES = ("cref_policy.h", "cref_policy.c")
VARIANTS = tuple(variant for variant in network.VARIANTS if variant != "hpl")
_TEMPLATES = Path(__file__).parent / "c"
_LIMITS: dict[ModuleType, tuple[str, ...]] = {
    policy: ("LATE", "STOP_AFTER", "START_AGAIN", "FAR", "START_SPEED", "STILL"),
    senses: (
        "GRAVITY_LENGTH", "UPRIGHT", "MOST_TURNING", "MOST_JOINT_SPEED", "POSE_MARGIN",
        "MOST_FOOT_TILT", "MOST_CHANGE", "MOST_SAG", "MOST_APART",
    ),
    camera: ("LEAST_SEEN", "NEAREST_GROUND", "UPSIDE_DOWN", "FROZEN_FRAMES"),
    cross_checks: ("FROZEN_MOTION",),
}  # fmt: skip


def write_c(content: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, bytes]:
    """Write cref_policy.h and cref_policy.c of a manifest and its weights, by file name.

    Every `#include` of a file of `c/`, or of a part generated here, is replaced by its text.

    Raises:
        ConfigError: `network.c` does not have the network.
    """
    if (variant := content["network"]["variant"]) not in VARIANTS:
        raise ConfigError(f"C has the networks {', '.join(VARIANTS)}, not {variant}; use numpy")
    weights = {
        re.sub("recurrent$", "recurrent/kernel", name): np.asarray(x, np.float32)
        for name, x in sorted(arrays.items())
        if name != "log_std"  # needed only to continue training
    }
    parts = {
        "sizes.h": _sizes(content, weights),
        "status.h": _status_flags(),
        "limits.c": _limits(content),
        "status_text.c": _status_text(),
        "tables.c": _tables(content, weights),
    }
    return {name: _include(name, parts).encode() for name in NAMES}


def _include(name: str, parts: dict[str, str]) -> str:
    """Read a file of `c/` and put the files that it includes in their places."""

    def replace(match: re.Match[str]) -> str:
        other = match.group(1)
        if other == "cref_policy.h":
            return match.group(0)
        return (parts[other] if other in parts else _include(other, parts)).rstrip("\n")

    text = (_TEMPLATES / name).read_text(encoding="utf-8")
    return re.sub(r'^#include "(.*)"$', replace, text, flags=re.MULTILINE)


def _sizes(content: dict[str, Any], weights: dict[str, np.ndarray]) -> str:
    """Define the sizes of arrays, and the numbers of the manifest that a program may want."""
    net, guards, joints = content["network"], content["guards"], content["joints"]
    variant, legs = net["variant"], content.get("legs", [])
    sees = variant != "blind"
    attends = sees and variant != "no_cross_attention"
    sizes: dict[str, Any] = {
        "JOINTS": len(joints),
        "CONTROL_HZ": content["rates"]["control_hz"],
        "PERIOD": "(1.0 / CREF_CONTROL_HZ) /* s */",
        "START_AFTER": f"{policy.START_AFTER} /* s */",
        "HOLD_STEPS": guards["hold_steps"],
        "SEES": int(sees),
        **(_camera_sizes(content) if sees else {}),
        "OBSERVATION": 9 + 3 * len(joints),
        "TOKEN": net["token"],
        "FUSED": (2 if sees else 1) * net["token"],
        "LSTM": net["lstm"],
        "GRU": net["gru"],
        "HEADS": net["heads"] if attends else 0,
        "GATED": int(variant != "no_grf"),
        "HIGHWAY": int(variant != "no_highway"),
        "HEAD_LAYERS": len(net["actor"]) + 1,
        "WIDEST": max([1, *net["actor"]]),
        "LEGS": len(legs),
    }
    if legs:
        sizes |= {"LEG_JOINTS": len(legs[0]["joints"]), "TILTS": 2 * senses.TILTS}
    digest = hashlib.sha256(b"".join(x.tobytes() for x in weights.values())).hexdigest()
    names = "\n".join(f"     {j:2d} {joint['name']}" for j, joint in enumerate(joints))
    return "\n".join([
        f'#define CREF_WEIGHTS "{digest[:16]}" /* tells policies apart, in a log */',
        "",
        f"/* Joints, in the order of all arrays:\n{names} */",
        *(f"#define CREF_{name} {value}" for name, value in sizes.items()),
    ])  # fmt: skip


def _camera_sizes(content: dict[str, Any]) -> dict[str, Any]:
    """List the sizes of the depth branch."""
    net, depth, guards = content["network"], content["depth"], content["guards"]
    rows, columns, channels = depth["rows"], depth["columns"], 1
    work, patch = rows * columns, 0
    for layer in net["convolutions"]:
        patch = max(patch, layer["kernel"] ** 2 * channels)
        rows, columns = rows // layer["stride"], columns // layer["stride"]
        channels = layer["channels"]
        work = max(work, rows * columns * channels)
    return {
        "ROWS": depth["rows"],
        "COLUMNS": depth["columns"],
        "D_MAX": f"{_number(depth['d_max_m'])} /* m */",
        "WINDOW": depth.get("window", 1),
        "MAX_INVALID": f"{guards['max_invalid']} /* share of a frame's pixels that may be holes */",
        "STALE": f"{guards['stale_s']} /* s */",
        "CONVOLUTIONS": len(net["convolutions"]),
        "PATCH": patch,
        "WORK": work,
        "TOKENS": rows * columns,
        "COMPRESSED": net["compressed"],
    }


def _status_flags() -> str:
    """Define the flags of a status, with the names and numbers of the runtime's."""
    lines = ["/* Faults of a step or a frame. */", "enum cref_status {", "    CREF_OK = 0,"]
    for flag in WHY:
        note = " /* by cref_runtime.py only */" if flag & STOPPING else ""
        lines.append(f"    CREF_{flag.name} = 1 << {int(flag).bit_length() - 1},{note}")
    faults = " | ".join(f"CREF_{flag.name}" for flag in Status if flag & FAULTS)
    return "\n".join([*lines, f"    CREF_FAULTS = {faults}", "};"])


def _status_text() -> str:
    """Write the function that says what a flag means."""
    lines = [
        "const char *cref_status_text(unsigned status)",
        "{",
        "    switch (status & (~status + 1)) { /* the lowest flag */",
        "    case CREF_OK:",
        '        return "all is right";',
    ]
    for flag, words in WHY.items():
        said = words.partition(" (load(")[0]  # an argument of the runtime in Python
        parts = textwrap.wrap(f"{flag.name}: {said}", 80, drop_whitespace=False)
        lines.append(f"    case CREF_{flag.name}:")
        lines.append("        return " + "\n               ".join(f'"{p}"' for p in parts) + ";")
    return "\n".join([*lines, "    }", '    return "no such status";', "}"])


def _limits(content: dict[str, Any]) -> str:
    """Define the runtime's limits with its comments, and the manifest's."""
    lines = []
    for module, names in _LIMITS.items():
        source = Path(module.__file__ or "").read_text(encoding="utf-8")
        for name in names:
            found = re.search(rf"^{name} = .*?#\s*(.*)$", source, re.MULTILINE)
            note = f" /* {found.group(1)} */" if found else ""
            value = getattr(module, name)
            named = (
                {"_LOW": value[0], "_HIGH": value[1]} if isinstance(value, tuple) else {"": value}
            )
            lines += [f"#define {name}{end} ({number}){note}" for end, number in named.items()]
    obs, command, legs = content["observation"], content["command"], content.get("legs", [])
    order = [joint["name"] for joint in content["joints"]]
    lines += [
        f"#define OBSERVATION_CLIP {_number(obs['clip'])}",
        f"#define ACTION_CLIP {_number(content['action']['clip'])}",
        "",
        _floats("observation_mean", obs["mean"]),
        _floats("observation_std", obs["std"]),
        _floats("command_low", command["low"]),
        _floats("command_high", command["high"]),
    ]
    if legs:
        joints = [[order.index(joint["name"]) for joint in leg["joints"]] for leg in legs]
        axes = [[joint["axis"] for joint in leg["joints"]] for leg in legs]
        lines += [
            "",
            "/* From the hip down; axes in the base's frame, all joints at 0. */",
            f"static const int leg_joints[CREF_LEGS][CREF_LEG_JOINTS] = {_braces(joints)};",
            f"static const double leg_axes[CREF_LEGS][CREF_LEG_JOINTS][3] = {_braces(axes)};",
        ]
    return "\n".join([*lines, "", _joints(content)])


def _joints(content: dict[str, Any]) -> str:
    """Define the joints, with the limits of their targets."""
    guards, lines = content["guards"], []
    keys = ("default_rad", "low_rad", "high_rad", "kp", "kd", "effort_nm", "action_scale_rad")
    for joint, *limits in zip(
        content["joints"], guards["rate_rad"], guards["beyond_rad"], strict=True
    ):
        numbers = ", ".join(_number(x) for x in [*(joint[key] for key in keys), *limits])
        lines.append(f'    {{"{joint["name"]}", {numbers}}},')
    head = "const struct cref_joint cref_joints[CREF_JOINTS] = {"
    return "\n".join([head, *lines, "};"])


def _tables(content: dict[str, Any], weights: dict[str, np.ndarray]) -> str:
    """Define the weights, and the layers that they belong to."""
    parts = ["/* " + "-" * 64 + " the layers and their weights */", ""]
    for name, array in weights.items():
        parts.append(_floats(_identifier(name), array.ravel()))
    for name, array in weights.items():
        layer, _, kind = name.rpartition("/")
        own = _identifier(layer)
        if kind == "kernel":
            inputs, outputs = array.shape
            bias = f"{own}_bias" if f"{layer}/bias" in weights else "NULL"
            numbers = f"{{{inputs}, {outputs}, {own}_kernel, {bias}}}"
            parts.append(f"static const struct dense {own} = {numbers};")
        elif kind == "scale":
            parts.append(f"static const struct norm {own} = {{{own}_scale, {own}_bias}};")
    net = content["network"]
    head = ", ".join(f"&action_head_layer_{i}" for i in range(len(net["actor"]) + 1))
    parts.append(f"static const struct dense *const action_head[CREF_HEAD_LAYERS] = {{{head}}};")
    if net["variant"] != "blind":
        layers = ", ".join(
            f"{{{layer['kernel']}, {layer['stride']}, &depth_tokenizer_layer_{i}_filter}}"
            for i, layer in enumerate(net["convolutions"])
        )
        kind = "static const struct convolution"
        parts.append(f"{kind} convolutions[CREF_CONVOLUTIONS] = {{{layers}}};")
    return "\n".join(parts)


def _identifier(name: str) -> str:
    return name.replace("/", "_")


def _floats(name: str, values: Sequence[float] | np.ndarray) -> str:
    """Define a table of float32."""
    numbers = [f"{x!s}f" for x in np.asarray(values, np.float32)]
    lines = [", ".join(numbers[i : i + 8]) for i in range(0, len(numbers), 8)]
    text = ",\n    ".join(lines)
    return f"static const float {name}[{len(numbers)}] = {{\n    {text}}};"


def _number(value: float) -> str:
    """Write a float32 with as few digits as tell it from its neighbours."""
    return f"{np.float32(value)!s}f"


def _braces(values: Any) -> str:
    """Write nested lists of numbers as an initialiser."""
    return "{" + ", ".join(map(_braces, values)) + "}" if isinstance(values, list) else str(values)
