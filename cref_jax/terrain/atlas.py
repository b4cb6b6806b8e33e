"""All lanes in one grid, and which of them a robot walks on."""

from typing import no_type_check

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray

from cref_jax.errors import ConfigError
from cref_jax.terrain import column_grid
from cref_jax.terrain.column_grid import Grid, Terrain

MAX_COLUMNS = 2e8  # of a grid; 0.8 GB; assumed


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@flax.struct.dataclass
class Atlas:
    """All lanes in one grid: rows are the variants of each level, columns are kinds."""

    terrain: Grid
    places: Float[np.ndarray | Array, "rows kinds places 2"]  # m, x and height of level stretches
    # before the last obstacle of each lane; NaN where there are none
    sizes: Float[np.ndarray | Array, "levels kinds"]  # m; m/m for a slope
    kinds: tuple[str, ...] = flax.struct.field(pytree_node=False)
    is_profile: tuple[bool, ...] = flax.struct.field(pytree_node=False)  # each kind: level across
    turns: tuple[int, ...] = flax.struct.field(pytree_node=False)  # kinds that robots get in turn
    variants: int = flax.struct.field(pytree_node=False, default=1)  # of each level of each kind

    @property
    def levels(self) -> int:
        """Number of levels."""
        return self.sizes.shape[0]

    @property
    def length(self) -> float:
        """Length of a lane, m."""
        return self.terrain.size[0] * self.terrain.cell

    @property
    def end(self) -> Float[ArrayLike, ""]:
        """Where a lane ends, m along it."""
        return self.terrain.origin[0] + self.length

    def kind_of(self, robot: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
        """Return the kind of lane that the robots of these numbers are on."""
        return np.asarray(self.turns)[robot % len(self.turns)]

    def tile(
        self, level: Int[ArrayLike, ""], kind: Int[ArrayLike, ""], variant: Int[ArrayLike, ""] = 0
    ) -> Terrain:
        """Return one lane: x from 0 at its start, y from 0 in its middle, z = 0 at the start."""
        return column_grid.tile(self.terrain, level * self.variants + variant, kind)

    def level_place(
        self,
        kind: Int[Array, ""],
        level: Int[Array, ""],
        variant: Int[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Draw where a robot may start on a lane, x and height, m; NaN where at its start alone."""
        of_lane = jnp.asarray(self.places)[level * self.variants + variant, kind]
        x, z = of_lane[jax.random.randint(key, (), 0, of_lane.shape[0])]
        return x, z


def check_columns(shape: tuple[int, int], what: str) -> None:
    """Refuse a grid that would not fit into memory."""
    if shape[0] * shape[1] > MAX_COLUMNS:
        raise ConfigError(f"{what} has {shape[0]} x {shape[1]} columns, more than {MAX_COLUMNS:g}")
