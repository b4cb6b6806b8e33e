"""All lanes in one grid, and the assignment of robots to lanes."""

from typing import no_type_check

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray

from cref_jax.errors import ConfigError
from cref_jax.terrain import column_grid
from cref_jax.terrain.column_grid import Grid, Terrain

MAX_COLUMNS = 2e8  # per grid; 0.8 GB; assumed


@no_type_check  # vmap and tree.map put batches and non-arrays in it
@flax.struct.dataclass
class Atlas:
    """All lanes in one grid: rows are the variants of each level, columns are kinds."""

    terrain: Grid
    places: Float[np.ndarray | Array, "rows kinds places 2"]
    """m, x and height of level stretches before each lane's last obstacle; NaN if it has none."""
    sizes: Float[np.ndarray | Array, "levels kinds"]  # m; m/m for a slope
    kinds: tuple[str, ...] = flax.struct.field(pytree_node=False)
    is_profile: tuple[bool, ...] = flax.struct.field(pytree_node=False)  # per kind: level across
    turns: tuple[int, ...] = flax.struct.field(pytree_node=False)  # kinds, assigned round-robin
    variants: int = flax.struct.field(pytree_node=False, default=1)  # per level and kind

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
        """End of a lane, x in m."""
        return self.terrain.origin[0] + self.length

    def kind_of(self, robot: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
        """Return the kind of lane of each robot index."""
        return np.asarray(self.turns)[robot % len(self.turns)]

    def tile(
        self, level: Int[ArrayLike, ""], kind: Int[ArrayLike, ""], variant: Int[ArrayLike, ""] = 0
    ) -> Terrain:
        """Return one lane: x = 0 and z = 0 at its start, y = 0 in its middle."""
        return column_grid.tile(self.terrain, level * self.variants + variant, kind)

    def sample_level_place(
        self,
        kind: Int[Array, ""],
        level: Int[Array, ""],
        variant: Int[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Sample a start on a level stretch of a lane: x and height, m; NaN if it has none."""
        of_lane = jnp.asarray(self.places)[level * self.variants + variant, kind]
        x, z = of_lane[jax.random.randint(key, (), 0, of_lane.shape[0])]
        return x, z


def check_columns(shape: tuple[int, int], name: str) -> None:
    """Check that a grid of this shape fits into memory.

    Raises:
        ConfigError: it has more than MAX_COLUMNS columns.
    """
    if shape[0] * shape[1] > MAX_COLUMNS:
        raise ConfigError(f"{name} has {shape[0]} x {shape[1]} columns, more than {MAX_COLUMNS:g}")
