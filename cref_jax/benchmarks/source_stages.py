"""The stage of an iteration that an instruction belongs to, by the source it was traced from."""

from cref_jax.benchmarks.hlo import Frame

STAGES = (  # stage, file and, unless empty, function in the stack; the first match counts
    ("physics: MJX, line search", "mjx/_src/solver.py", "_linesearch"),
    ("physics: MJX, Newton", "mjx/_src/solver.py", ""),
    ("physics: MuJoCo Warp", "cref_jax/physics/mjx_engine.py", "WarpEngine"),
    ("physics: MJX, before the solver", "cref_jax/physics/mjx_engine.py", ""),
    ("physics: MuJoCo C", "cref_jax/physics/mujoco_engine.py", ""),
    ("physics: tangent planes", "cref_jax/physics/simulation.py", "planes"),
    ("physics: rest", "cref_jax/physics/simulation.py", "step"),
    ("update", "cref_jax/ppo/learner.py", "update"),
    ("update", "cref_jax/training/distillation.py", "update"),
    ("policy", "cref_jax/training/rollout.py", "apply_policy"),
    ("depth", "cref_jax/training/camera_feed.py", "render_frames"),
    ("environment: rest", "cref_jax/env/", ""),
    ("rollout: rest", "cref_jax/training/rollout.py", ""),
)
REST = "rest"


def stage_of(stack: tuple[Frame, ...]) -> str:
    """Return the stage of a source stack by its files and functions; `REST` without a match."""
    return next((name for name, *place in STAGES if is_at(stack, *place)), REST)


def is_at(stack: tuple[Frame, ...], file: str, function: str) -> bool:
    """Check whether a stack passes through the file and, unless it is empty, the function."""
    return any(
        file in frame.file and function in ("", *frame.function.split(".")) for frame in stack
    )
