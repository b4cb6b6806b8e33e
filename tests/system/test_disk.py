"""Files that were cut while they were written."""

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
