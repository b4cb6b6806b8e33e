"""The numbers in a user's map: .npy, .png or .tif, with what a survey leaves out refused."""

import hashlib
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from cref_jax.errors import ConfigError
from cref_jax.terrain import atlas

SUFFIXES = (".npy", ".png", ".tif", ".tiff")
FOREIGN = (".asc", ".exr", ".geojson", ".hgt", ".jpg", ".jpeg", ".las", ".npz", ".obj", ".stl",
           ".vrt", ".xyz")  # fmt: skip
GREY = ("L", "I", "I;16", "I;16B", "F")  # modes of Pillow
NO_DATA = (-32768.0, -32767.0, -9999.0, -99999.0, float(np.float32(-3.4028235e38)))
"""Values that surveys write where nothing was measured"""
NO_DATA_TAG = 42113  # of a GeoTIFF

Values = Float[np.ndarray, "X Y"]  # in the file's own unit


def is_map(name: str) -> bool:
    """Check whether a terrain's name is a map's file, in small or capital letters.

    Raises:
        ConfigError: it is a file of a kind that maps come in and this cannot read.
    """
    suffix = Path(name).suffix.lower()
    if suffix in FOREIGN:
        raise ConfigError(f"{name}: a map is .npy, .png or .tif, not {suffix}")
    return suffix in SUFFIXES


def digest(path: Path) -> str:
    """Compute the SHA-256 of a map and the TOML file beside it."""
    total = hashlib.sha256(path.read_bytes())
    total.update(path.with_suffix(".toml").read_bytes())
    return total.hexdigest()


def read_values(path: Path) -> Values:
    """Read a map; an array's first axis is x, a picture shows x to the right and y up.

    Raises:
        ConfigError: there is no such file, or its values are no heights.
    """
    is_array = path.suffix.lower() == ".npy"
    values, no_data = (_read_array(path), None) if is_array else _read_picture(path)
    unknown = ~np.isfinite(values)
    if unknown.any():
        raise ConfigError(f"{path} has {unknown.sum()} heights that are not finite; fill them in")
    empty = np.isin(values, NO_DATA if no_data is None else (*NO_DATA, no_data))
    if empty.any():
        which = ", ".join(f"{value:g}" for value in np.unique(values[empty]))
        raise ConfigError(f"{path} has {empty.sum()} heights without data ({which}); fill them in")
    return values


def _read_array(path: Path) -> Values:
    try:
        heights = np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise ConfigError(f"no file {path}") from None
    except Exception as error:  # numpy raises many kinds for a damaged header
        raise _unreadable(path, error) from None
    if heights.ndim != 2 or 0 in heights.shape or heights.dtype.kind not in "fiu":
        raise ConfigError(f"{path} must hold numbers [X, Y], not {heights.dtype}{heights.shape}")
    atlas.check_columns(heights.shape, str(path))
    return heights.astype(np.float64)


def _read_picture(path: Path) -> tuple[Values, float | None]:
    """Read a grey picture and, of a GeoTIFF, the value that stands for no data."""
    try:
        with Image.open(path) as image:
            atlas.check_columns(image.size, str(path))
            _check_pixels(path, image)
            tag = getattr(image, "tag_v2", {}).get(NO_DATA_TAG)
            return np.asarray(image)[::-1].T.astype(np.float64), _read_number(tag)
    except FileNotFoundError:
        raise ConfigError(f"no file {path}") from None
    except ConfigError:
        raise
    except Exception as error:  # Pillow raises many kinds for a damaged file
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: Exception) -> ConfigError:
    """Say in one line why a file cannot be read."""
    return ConfigError(f"{path}: {' '.join(str(error).split()) or type(error).__name__}")


def _check_pixels(path: Path, image: Image.Image) -> None:
    """Refuse colours, transparency, and grey of so few bits that Pillow stretches it."""
    if image.mode in ("LA", "PA", "RGBA") or "transparency" in image.info:
        raise ConfigError(f"{path} is transparent in places, which are no heights; remove that")
    bits = _png_bits(path) if image.format == "PNG" else 8
    if image.mode not in GREY or bits < 8:
        shown = f"{bits} bits" if image.mode in GREY else image.mode
        raise ConfigError(f"{path} must be grey with 8 or 16 bits, not {shown}")


def _png_bits(path: Path) -> int:
    """Read the bits per sample in a PNG's header."""
    with path.open("rb") as file:
        return int(struct.unpack_from(">B", file.read(25), 24)[0])


def _read_number(tag: object) -> float | None:
    try:
        return float(str(tag).strip("\0 "))
    except ValueError:
        return None
