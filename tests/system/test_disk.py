"""Files that were cut while they were written."""

import pytest

from cref_jax.system import disk


def test_a_cut_last_line_loses_that_line_alone(tmp_path):
    path = tmp_path / "lines.jsonl"
    for number, end in enumerate(("\n", "", "\n")):
        with disk.append_lines(path) as file:
            file.write(f'{{"n": {number}}}' + end)
    assert disk.read_objects(path) == [{"n": 0}, {"n": 1}, {"n": 2}]
    path.write_bytes(path.read_bytes() + b'{"n": "\xc3')
    with disk.append_lines(path) as file:
        file.write('{"n": 4}\n')
    assert [found["n"] for found in disk.read_objects(path)] == [0, 1, 2, 4]


def test_a_line_that_is_no_object_is_left_out(tmp_path):
    path = tmp_path / "lines.jsonl"
    path.write_text('5\n{"n": 1}\n\nnull\n' + "[" * 100_000 + "\n")
    assert disk.read_objects(path) == [{"n": 1}]
    assert disk.read_objects(tmp_path / "none") == []


def test_what_does_not_fit_leaves_the_files_before_and_is_named(tmp_path, monkeypatch):
    first, second = tmp_path / "first", tmp_path / "second"
    disk.write_all({first: b"1", second: b"1"})
    write = disk.Path.write_bytes

    def fill_up(path, data):
        write(path, data[:1])
        if path.name.startswith("second"):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(disk.Path, "write_bytes", fill_up)
    with pytest.raises(OSError, match=f"No space left on device: '{second}'"):
        disk.write_all({first: b"22", second: b"22"})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {
        "first": b"1", "second": b"1",
    }  # fmt: skip
