"""Physics substeps with MuJoCo C, called from the XLA program: the engine for a CPU (Sec. II-D).

On a CPU, MuJoCo C steps several times as many robots per second as MJX. The call is pure: a robot's
whole state goes in and comes out, so that runs can be resumed bit for bit and an environment
behaves the same alone as in a batch. A program calls an engine by its number, which is derived from
the model: a cached program thus fits every engine of that model, in this process and later ones.
"""

import collections
import contextlib
import zlib
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array
from mujoco.batch import Batch

from cref_jax.physics import xla_callback
from cref_jax.physics.records import Dynamics, Substep, SubstepInput
from cref_jax.system import parallel

_TARGET = "cref_jax_mujoco_substep"
_ENGINES: "dict[int, MujocoEngine]" = {}  # the first engine of each number steps for all


class MujocoEngine:
    """Advances robots by one substep with MuJoCo C on all cores."""

    def __init__(self, model: mujoco.MjModel, trunk: int, threads: int = 0) -> None:
        """Set up the compiled model, with one force sensor per foot and `trunk`'s body id."""
        self._model = model
        self._trunk = trunk
        self._threads = threads or parallel.cores()
        self._number = _engine_number(model, trunk, self._threads)
        _ENGINES.setdefault(self._number, self)
        self._idle: dict[int, list[_Simulations]] = collections.defaultdict(list)

    def substep(self, robot: SubstepInput) -> Substep:
        """Advance one robot by one substep; a state that is not finite comes back as NaN."""
        shape = lambda x: jax.ShapeDtypeStruct(x.shape, np.float32)
        results = (
            *(shape(x) for x in (robot.qpos, robot.qvel, robot.warmstart)),
            jax.ShapeDtypeStruct((2, 3), np.float32),
        )
        number = jnp.int32(self._number)
        *state, dynamics = robot
        operands = (*state, *dynamics)
        return Substep(
            *jax.lax.platform_dependent(
                number,
                *operands,
                cpu=lambda *x: xla_callback.call(_TARGET, results, *x),
                default=lambda *x: jax.pure_callback(
                    _substep_callback, results, *x, vmap_method="broadcast_all"
                ),
            )
        )

    def advance(self, state: list[np.ndarray], dynamics: Dynamics) -> Substep:
        """Advance the robots' states [..., n] by one substep."""
        lead = state[0].shape[:-1]
        count = int(np.prod(lead, dtype=int))
        flat = [x.reshape(count, *x.shape[len(lead) :]) for x in state]
        varied = Dynamics(*(x.reshape(count, *x.shape[len(lead) :]) for x in dynamics))
        with self._simulations(count) as simulations:
            result = simulations.step(flat, varied)
        return Substep(*(x.reshape(*lead, *x.shape[1:]) for x in result))

    @contextlib.contextmanager
    def _simulations(self, count: int) -> Iterator["_Simulations"]:
        """Lend `count` simulations: several devices may step robots at the same time."""
        idle = self._idle[count]
        try:
            simulations = idle.pop()
        except IndexError:
            simulations = _Simulations(self._model, self._trunk, count, min(self._threads, count))
        yield simulations
        idle.append(simulations)


def _engine_number(model: mujoco.MjModel, trunk: int, threads: int) -> int:
    """Compute a number shared only by engines of the same model, trunk and threads."""
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return zlib.crc32(content, zlib.crc32(b"%d %d" % (trunk, threads))) >> 1  # fits an int32


def _substep(arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
    """Advance the robots of the engine whose number comes first."""
    number, *operands = arguments
    engine = _ENGINES[int(number.flat[0])]
    after = engine.advance(operands[:6], Dynamics(*operands[6:]))
    for result, value in zip(results, after, strict=True):
        result[...] = value


def _substep_callback(*arguments: Array) -> tuple[np.ndarray, ...]:
    """Run `_substep` for a device other than the CPU, which cannot call into this process."""
    operands = [np.asarray(x) for x in arguments]
    force = np.empty((*operands[1].shape[:-1], 2, 3), np.float32)
    results = [*(np.empty_like(x) for x in operands[1:4]), force]
    _substep(operands, results)
    return tuple(results)


xla_callback.register(_TARGET, _substep)


class _Simulations:
    """MuJoCo's own batch of `count` simulations, with live views of the arrays that change."""

    def __init__(self, model: mujoco.MjModel, trunk: int, count: int, threads: int) -> None:
        self._batch = Batch(model, count, threads)
        self._trunk = trunk
        names = ("qpos", "qvel", "qacc_warmstart", "ctrl", "mocap_pos", "mocap_quat")
        self._views = [self._batch.bind(name) for name in names]
        self._force = self._batch.bind("sensordata")
        self._mass = self._batch.expand("body_mass")
        self._com = self._batch.expand("body_ipos")
        self._friction = self._batch.expand("pair_friction")
        self._gain = self._batch.expand("actuator_gainprm")
        self._bias = self._batch.expand("actuator_biasprm")
        self._nominal_mass = float(model.body_mass[trunk])
        self._nominal_com = model.body_ipos[trunk].copy()

    def step(self, state: list[np.ndarray], dynamics: Dynamics) -> Substep:
        """Load every simulation's whole state, advance, and read the result as float32."""
        for view, value in zip(self._views, state, strict=True):
            view[:] = value
        self._apply(dynamics)
        qpos, qvel, warmstart = self._views[:3]
        # MuJoCo C would print a warning per step for each of these robots.
        bad = ~(np.isfinite(self._batch.state).all(axis=1))
        if bad.any():
            self._batch.reset(np.flatnonzero(bad))
        self._batch.step()
        force = -self._force.reshape(-1, 2, 3)  # by the ground on the foot
        result = [x.astype(np.float32) for x in (qpos, qvel, warmstart, force)]
        for x in result:
            x[bad] = np.nan
        return Substep(*result)

    def _apply(self, dynamics: Dynamics) -> None:
        self._friction[:, :, :2] = np.asarray(dynamics.friction)[:, None, None]
        self._mass[:, self._trunk] = self._nominal_mass + np.asarray(dynamics.payload)
        self._com[:, self._trunk] = self._nominal_com + np.asarray(dynamics.com_shift)
        driven = np.shape(dynamics.kp)[1]
        self._gain[:, :driven, 0] = dynamics.kp
        self._bias[:, :driven, 1] = -np.asarray(dynamics.kp)
        self._bias[:, :driven, 2] = -np.asarray(dynamics.kd)
