"""What all commands share: errors of one line, and files that can be written."""

import pytest

from cref_jax import cli
from cref_jax.errors import ConfigError, TrainingError


@pytest.mark.parametrize(("error", "code"), [(ConfigError("no"), 2), (TrainingError("no"), 1)])
def test_what_a_user_can_mend_is_one_line(capsys, error, code):
    with pytest.raises(SystemExit) as end, cli.one_line_errors():
        raise error
    assert end.value.code == code and capsys.readouterr().err == "error: no\n"
    with pytest.raises(type(error)), cli.one_line_errors(debug=True):
        raise error


def test_ctrl_c_leaves_a_program_that_calls_a_command_alive():
    with pytest.raises(KeyboardInterrupt), cli.one_line_errors(is_program=False):
        raise KeyboardInterrupt


def test_a_file_to_write_gets_its_folder_and_must_end_right(tmp_path):
    out = cli.prepare_output(tmp_path / "new" / "a.json", ".json")
    assert out.parent.is_dir()
    with pytest.raises(ConfigError, match=r"--out must end in \.json"):
        cli.prepare_output(tmp_path / "a.txt", ".json")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot make the folder"):
        cli.prepare_output(tmp_path / "file" / "a.json", ".json")
