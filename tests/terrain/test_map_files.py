"""Maps as surveys, cameras and editors write them: read right, or refused in one line."""

import numpy as np
import pytest
from PIL import Image, PngImagePlugin, TiffImagePlugin

from cref_jax import config
from cref_jax.errors import ConfigError
from cref_jax.terrain import lanes, map_files

SETTINGS = "cell = 0.1\nstart = [0.05, 0.05]\nscale = 0.01\n"
HEIGHTS = np.array([[1, 2, 3], [4, 5, 6]], np.int16)  # x, y


def heights(path, settings=SETTINGS):
    path.with_suffix(".toml").write_text(settings)
    return np.asarray(lanes.build(config.Terrain(name=str(path))).tile(0, 0).heights)


def refusal(path, settings=SETTINGS) -> str:
    with pytest.raises(ConfigError) as error:
        heights(path, settings)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("name", ["hill.npy", "HILL.NPY"])
def test_an_array_of_any_unit_is_read(tmp_path, name):
    with (tmp_path / name).open("wb") as file:
        np.save(file, HEIGHTS)
    np.testing.assert_allclose(heights(tmp_path / name), (HEIGHTS - 1) * 0.01, atol=1e-6)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("name", ["hill.tif", "Hill.TIFF"])
def test_a_tiff_is_seen_from_above(tmp_path, name, kind):
    Image.fromarray(HEIGHTS.T[::-1].astype(kind)).save(tmp_path / name, format="TIFF")
    np.testing.assert_allclose(heights(tmp_path / name), (HEIGHTS - 1) * 0.01, atol=1e-6)


@pytest.mark.parametrize("empty", [-32768, -9999])
def test_heights_without_data_are_refused_and_counted(tmp_path, empty):
    void = HEIGHTS.copy()
    void[0, 1:] = empty
    np.save(tmp_path / "hill.npy", void)
    said = refusal(tmp_path / "hill.npy")
    assert f"has 2 heights without data ({empty}); fill them in" in said


def test_a_geotiff_names_its_own_value_for_no_data(tmp_path):
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[map_files.NO_DATA_TAG] = "6"
    Image.fromarray(HEIGHTS.T[::-1].astype(np.float32)).save(tmp_path / "hill.tif", tiffinfo=tags)
    assert "has 1 heights without data (6)" in refusal(tmp_path / "hill.tif")


def test_heights_that_are_no_ground_are_refused(tmp_path):
    np.save(tmp_path / "hill.npy", np.array([[0.0, 12000.0]]))
    assert "heights of 0 to 120 m about the start's are no ground" in refusal(tmp_path / "hill.npy")
    assert heights(tmp_path / "hill.npy", SETTINGS.replace("0.01", "0.001")).max() == 12.0


@pytest.mark.filterwarnings("ignore")  # of numpy and Pillow
@pytest.mark.parametrize("name", ["hill.npy", "hill.png", "hill.tif"])
def test_a_damaged_map_is_refused_in_one_line_or_is_still_ground(tmp_path, name):
    path, rng = tmp_path / name, np.random.default_rng(5)
    if name == "hill.npy":
        np.save(path, HEIGHTS)
    else:
        Image.fromarray(HEIGHTS.astype(np.uint16)).save(path)
    whole, refused = path.read_bytes(), 0
    for cut in [b"", *(whole[:n] for n in (1, 5, 12, 40))]:
        path.write_bytes(cut)
        refusal(path)
    for _ in range(500):
        damaged = bytearray(whole)
        for place in rng.integers(len(whole), size=2):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            assert np.isfinite(map_files.read_values(path)).all()
        except ConfigError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > 50


@pytest.mark.parametrize("bits", [1, 2, 4])
def test_grey_of_few_bits_would_be_stretched(tmp_path, bits):
    image = Image.fromarray(np.zeros((4, 4), np.uint8)).convert("1" if bits == 1 else "L")
    image.save(tmp_path / "hill.png", bits=bits)
    data = bytearray((tmp_path / "hill.png").read_bytes())
    if bits > 1:  # as another program writes it: the header says so
        data[24] = bits
        data[29:33] = PngImagePlugin.o32(PngImagePlugin._crc32(bytes(data[12:29])))
        (tmp_path / "hill.png").write_bytes(data)
    said = refusal(tmp_path / "hill.png")
    assert "must be grey with 8 or 16 bits, not " + ("1" if bits == 1 else f"{bits} bits") in said


@pytest.mark.parametrize("mode", ["LA", "RGBA"])
def test_transparency_is_no_height(tmp_path, mode):
    Image.new(mode, (4, 4)).save(tmp_path / "hill.png")
    assert "is transparent in places" in refusal(tmp_path / "hill.png")


@pytest.mark.parametrize("name", ["dem.asc", "dem.NPZ", "scan.obj", "photo.JPG"])
def test_a_map_of_another_kind_is_told_what_maps_are(tmp_path, name):
    assert "a map is .npy, .png or .tif, not " in refusal(tmp_path / name)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ("cell = 0.1\nstart = [nan, 0]\n", "cell, start and scale must be finite"),
        ("cell = 0.1\nstart = [inf, 0]\n", "cell, start and scale must be finite"),
        ("cell = inf\nstart = [0, 0]\n", "cell, start and scale must be finite"),
        ("cell = 0.1\nstart = [0, 0]\nscale = nan\n", "cell, start and scale must be finite"),
        ("cell = 0.1\nstart = [0, 0]\nscale = 0\n", "scale must not be zero"),
        ("cell = 0.005\nstart = [0, 0]\n", "cell must be at least 0.01 m, not 0.005"),
        ("cell = 0.1\nstart = 0\n", "must be a list"),
    ],
)
def test_settings_that_are_no_numbers_are_refused(tmp_path, settings, says):
    np.save(tmp_path / "hill.npy", HEIGHTS)
    assert says in refusal(tmp_path / "hill.npy", settings)
