"""Whatever is given to the loader, it returns the policy that was exported or one error."""

import hashlib
import io
import json
import pickle
import random
import zipfile

import numpy as np
import pytest
from tiny_policy import ROBOT, J, contents, policy

from cref_jax import deploy
from cref_jax.deploy import PolicyFormatError
from cref_jax.policy import writer

MUTATIONS = 10_000


@pytest.fixture(scope="module")
def original() -> tuple[dict, dict]:
    """Return the manifest, with the second it was written in, and the weights of a small policy."""
    return contents(policy("full"))


@pytest.fixture(scope="module")
def files(original) -> dict[str, bytes]:
    """Return the files of that policy, whole."""
    manifest, arrays = original
    return signed(manifest, {"weights.npz": writer._to_npz(arrays)})


def signed(manifest, files) -> dict[str, bytes]:
    """Return the files with a manifest whose digests are right."""
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    manifest = {**manifest, "files": digests}
    manifest["digest"] = deploy.manifest_digest(manifest)
    return {**files, "manifest.json": json.dumps(manifest).encode()}


def put(folder, files):
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder


def changed(files, change):
    """Return the files after `change` of the manifest, with digests that are right."""
    manifest = json.loads(files["manifest.json"])
    change(manifest)
    return signed(manifest, {"weights.npz": files["weights.npz"]})


def weights(files, data):
    """Return the files with other weights, with digests that are right."""
    return signed(json.loads(files["manifest.json"]), {"weights.npz": data})


def npz(arrays, **settings) -> bytes:
    data = io.BytesIO()
    save = np.savez_compressed if settings.pop("compressed", False) else np.savez
    save(data, **arrays)
    return data.getvalue()


def test_what_was_written_is_read_from_the_directory_and_from_the_archive(
    tmp_path, files, original
):
    put(tmp_path, files)
    (tmp_path / "policy.zip").write_bytes(writer._zip_stored(files))
    for path in (tmp_path, tmp_path / "policy.zip"):
        manifest, arrays = deploy.contents(path)
        assert {k: manifest[k] for k in original[0]} == json.loads(json.dumps(original[0]))
        assert arrays.keys() == original[1].keys()
        assert all((arrays[k] == x).all() for k, x in original[1].items())
        assert deploy.load(path).joints.names == ROBOT.joint_names


def test_a_missing_or_empty_place_is_one_line(tmp_path, files):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.zip").write_text("no archive")
    places = {"nothing": "no such", "empty": "no file manifest.json", "text.zip": "zip file"}
    for name, message in places.items():
        with pytest.raises(PolicyFormatError, match=message) as found:
            deploy.load(tmp_path / name)
        assert str(tmp_path) in str(found.value) and "\n" not in str(found.value)


def test_the_robots_joints_must_be_the_policys(tmp_path, files):
    put(tmp_path, files)
    names = list(ROBOT.joint_names)
    deploy.load(tmp_path, joints=names)
    for wrong in (names[::-1], names[:-1], [*names, "tail_joint"]):
        with pytest.raises(PolicyFormatError, match="its joints are"):
            deploy.load(tmp_path, joints=wrong)


def bad_weights(files):
    """Yield weights that no reader should take, and what is said of them; digests are right."""
    whole = dict(np.load(io.BytesIO(files["weights.npz"])))
    name = "action_head/layer_2/bias"
    one = lambda x: {**whole, name: x}
    yield "objects", npz(one(np.array([{}] * J, object))), "not an array of numbers"
    yield "another type", npz(one(whole[name].astype(np.float64))), "must be float32"
    yield "big endian", npz(one(whole[name].astype(">f4"))), "not an array of numbers"
    yield "another shape", npz(one(whole[name][:-1])), "must be float32"
    yield "NaN", npz(one(np.full(J, np.nan, np.float32))), "not finite"
    yield "one missing", npz({k: x for k, x in whole.items() if k != name}), f"no '{name}'"
    yield "one more", npz({**whole, "../../etc/x": whole[name]}), "unknown"
    yield "compressed", npz(whole, compressed=True), "compressed"
    yield "no arrays", npz({}), "has no"
    yield "a pickle", pickle.dumps(whole), ""
    yield "one array", npy(whole[name]), ""
    huge = npy(whole[name]).replace(b"(12,), }", b"(1000000000000,), }")
    assert len(huge) > len(npy(whole[name]))
    yield "a false size", archive({f"{name}.npy": huge}), "does not have the size"
    twice = io.BytesIO(files["weights.npz"])
    with zipfile.ZipFile(twice, "a") as more, pytest.warns(UserWarning, match="Duplicate"):
        more.writestr(f"{name}.npy", npy(whole[name]))
    yield "one twice", twice.getvalue(), "two files of one name"
    for share in (0.0, 0.3, 0.9, 0.999):
        yield f"cut at {share}", files["weights.npz"][: int(share * len(files["weights.npz"]))], ""


def npy(array) -> bytes:
    data = io.BytesIO()
    np.save(data, array)
    return data.getvalue()


def archive(files) -> bytes:
    return writer._zip_stored(files)


def test_damaged_weights_are_refused_even_where_the_digest_is_right(tmp_path, files):
    for case, data, message in bad_weights(files):
        put(tmp_path, weights(files, data))
        with pytest.raises(PolicyFormatError, match=message or None):
            deploy.load(tmp_path)
            pytest.fail(case)


BAD_TEXT = {
    "empty": b"",
    "no JSON": b"{",
    "no object": b"[]",
    "NaN": b'{"format": NaN}',
    "infinite": b'{"format": Infinity}',
    "a key twice": b'{"format": "cref-policy", "format": "cref-policy"}',
    "deep": b"[" * 100_000,
    "no text": b"\xff\xfe",
    "large": b" " * (1 << 20) + b"{}",
}


@pytest.mark.parametrize("case", BAD_TEXT)
def test_a_manifest_that_is_no_manifest_is_refused(tmp_path, files, case):
    put(tmp_path, {**files, "manifest.json": BAD_TEXT[case]})
    with pytest.raises(PolicyFormatError):
        deploy.load(tmp_path)


def at(*keys):
    """Return a function that sets what stands there in a manifest."""

    def place(value):
        def change(manifest):
            for key in keys[:-1]:
                manifest = manifest[key]
            manifest[keys[-1]] = value

        return change

    return place


BAD_NUMBERS = {
    "another schema": at("schema")(2),
    "another format": at("format")("onnx"),
    "too few joints": lambda m: m["joints"].pop(),
    "a joint twice": lambda m: m["joints"][1].update(name=m["joints"][0]["name"]),
    "joints that are text": at("joints")("left_knee_joint"),
    "a text for a number": at("joints", 0, "kp")("100"),
    "a truth for a number": at("joints", 0, "kp")(True),
    "too large a number": at("joints", 0, "kp")(1e300),
    "too large a whole number": at("joints", 0, "kp")(10**400),
    "a range upside down": at("joints", 0, "low_rad")(3.0),
    "terms in another order": lambda m: m["observation"]["terms"].reverse(),
    "a deviation of zero": at("observation", "std", 3)(0.0),
    "an unknown variant": at("network", "variant")("transformer"),
    "another variant": at("network", "variant")("no_grf"),
    "other heads": at("network", "heads")(3),
    "a wider network": at("network", "gru")(4096),
    "half a width": at("network", "gru")(7.5),
    "no stride": at("network", "convolutions", 0, "stride")(0),
    "another stride": at("network", "convolutions", 0, "stride")(2),
    "a huge image": at("depth", "rows")(1024),
    "no depth": at("depth")(None),
    "no guards": lambda m: m.pop("guards"),
    "a negative depth": at("depth", "d_max_m")(-3.0),
}


@pytest.mark.parametrize("case", BAD_NUMBERS)
def test_a_manifest_that_does_not_fit_is_refused_even_where_its_digest_is_right(
    tmp_path, files, case
):
    put(tmp_path, changed(files, BAD_NUMBERS[case]))
    with pytest.raises(PolicyFormatError):
        deploy.load(tmp_path)


@pytest.mark.slow
def test_no_mutation_is_another_error_or_silently_another_policy(tmp_path, files):
    rng = random.Random(0)
    put(tmp_path, files)
    original = deploy.contents(tmp_path)
    loaded, touched = 0, {}  # what the last mutation may have left damaged is written anew
    for _ in range(MUTATIONS):
        name = rng.choice(list(files))
        put(tmp_path, touched)
        if rng.random() < 0.2:
            touched = {"manifest.json": files["manifest.json"]}
            put(tmp_path, changed(files, lambda m: another(m, rng)))
            try:
                deploy.load(tmp_path)  # another policy, and it says so by its digest
            except PolicyFormatError:
                continue
            manifest = deploy.contents(tmp_path)[0]
            assert manifest == original[0] or manifest["digest"] != original[0]["digest"]
            continue
        touched = {name: files[name]}
        (tmp_path / name).write_bytes(mutated(files[name], rng))
        try:
            deploy.load(tmp_path)
        except PolicyFormatError:
            continue
        loaded += 1
        manifest, arrays = deploy.contents(tmp_path)
        assert manifest == original[0]
        assert all((arrays[k] == x).all() for k, x in original[1].items())
    assert loaded < 0.1 * MUTATIONS  # such as one space for another between two numbers


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Return the bytes with something done to them that happens to files."""
    start, length = rng.randrange(len(data)), rng.choice((1, 1, 1, 4, 64, 4096))
    there = data[start : start + length]
    kind = rng.randrange(6)
    if kind == 0:
        return data[:start]
    if kind == 1:
        return data[:start] + bytes(len(there)) + data[start + length :]
    if kind == 2:
        return data[:start] + data[start + length :]
    if kind == 3:
        return data[:start] + there + data[start:]
    if kind == 4:
        flipped = bytes([there[0] ^ (1 << rng.randrange(8))])
        return data[:start] + flipped + data[start + 1 :]
    return data[:start] + rng.randbytes(len(there)) + data[start + length :]


def another(manifest, rng: random.Random) -> None:
    """Put something else somewhere in the manifest, or take something away."""
    place, key = manifest, rng.choice([k for k in manifest if k not in ("files", "digest")])
    while isinstance(place[key], dict | list) and place[key] and rng.random() < 0.9:
        place = place[key]
        key = rng.choice(list(place)) if isinstance(place, dict) else rng.randrange(len(place))
    values = [None, True, -1, 0, 1, 7, 10**30, 0.5, -1e300, "x", "", [], {}, [1, 2], {"a": 1}]
    if rng.random() < 0.2:
        del place[key]
    else:
        place[key] = rng.choice(values)
