"""The command: killed and started again it gives the same tables, and it says where it stands."""

import json

import pytest
from fake_commands import FakeRunner, Killed

from cref_jax import reproduce
from cref_jax.errors import TrainingError
from cref_jax.reproduction import plan as planning

PARAMETERS = {"policy": 100, "critic": 50}


@pytest.fixture
def plan(monkeypatch):
    """Return three variants x two seeds, of four iterations each."""
    names = ("full", "no_highway", "blind")
    counted = {name: PARAMETERS for name in names}
    monkeypatch.setattr(reproduce, "_count_parameters", lambda plan: counted)
    settings = ("--ppo.minibatches", "2")
    return planning.build(names, (0, 1), "mixed", "cpu", 20, 4 * 192.0, 8, settings)


def tables(folder):
    """Return what the result says of the variants; times are left out."""
    return json.loads((folder / "reproduction.json").read_text())["variants"]


def run(folder, plan, **kills):
    folder.mkdir(exist_ok=True)
    runner = FakeRunner(**kills)
    reproduce.reproduce(folder, plan, runner)
    return runner


def test_a_plan_killed_twice_gives_the_same_tables(tmp_path, plan, monkeypatch):
    monkeypatch.setattr(reproduce.reproduction_page, "write", lambda *_: None)
    straight = run(tmp_path / "straight", plan)
    # four iterations per row; two suites, one for the variant without a gate
    assert len(straight.log) == 6 * 4 + 2 * (2 + 1 + 2)
    assert straight.log[:6] == [*(f"full-seed0 {k}" for k in range(1, 5)), "full-seed0 table",
                                "full-seed0 gate"]  # fmt: skip
    # the last of four levels, each averaged over a twentieth of them: itself
    assert tables(tmp_path / "straight")[2]["levels"]["gap"]["each"] == [2.11, 2.11]  # blind-seed0
    for step in range(0, len(straight.log) - 1, 3):
        folder = tmp_path / str(step)
        with pytest.raises(Killed):
            run(folder, plan, kill_before=step)
        with pytest.raises(Killed):
            run(folder, plan, kill_before=1)  # and again, one step further on
        last = run(folder, plan)
        assert tables(folder) == tables(tmp_path / "straight")
        assert len(last.log) <= len(straight.log) - step + 2  # at most the unsaved is done again


def test_a_plan_that_is_stopped_saves_and_starts_nothing_more(tmp_path, plan, capsys):
    runner = run(tmp_path, plan, stop_before=6)  # in the first iteration of the second row
    assert runner.log[-1] == "no_highway-seed0 1"
    said = capsys.readouterr().out
    assert "row 2 of 6, no_highway-seed0: training" in said and "row 3" not in said
    goes_on = run(tmp_path, plan)
    assert goes_on.log[0] == "no_highway-seed0 2"
    assert "no_highway-seed0: training goes on" in capsys.readouterr().out


def test_an_unfinished_row_has_no_part_in_the_tables_and_is_marked(tmp_path, plan):
    with pytest.raises(Killed):
        run(tmp_path, plan, kill_before=6 + 3)
    full, no_highway, blind = tables(tmp_path)
    assert full["seeds"] == [0] and full["success"]["overall"]["seeds"]["deviation"] is None
    assert no_highway["seeds"] == blind["seeds"] == [] and "success" not in blind
    rows = json.loads((tmp_path / "reproduction.json").read_text())["rows"]
    assert rows[0]["curves"] == {
        "samples": [192, 384, 576, 768], "levels": {"gap": [0.6, 1.1, 1.6, 2.1]},
    }  # fmt: skip
    assert no_highway["levels"] == {} and rows[2]["curves"] is None
    page = (tmp_path / "reproduction.html").read_text()
    assert (
        "1 of 6" in page and "full, single run so far" in page and "unfinished: not begun" in page
    )


def test_a_training_that_fails_is_named(tmp_path, plan, monkeypatch):
    monkeypatch.setattr(FakeRunner, "run", lambda *_: 1)
    with pytest.raises(TrainingError, match="row 1 of 6, full-seed0: train has ended with exit"):
        run(tmp_path, plan)


def test_settings_whose_quotes_are_open_are_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit):
        reproduce.main(["--plan", "--out", str(tmp_path / "out"), '--settings="--ppo.epochs 3'])
    assert capsys.readouterr().err == 'error: --settings "--ppo.epochs 3: No closing quotation\n'


def test_the_plan_is_printed_and_nothing_is_written(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")  # and is whole on a narrow terminal
    out = tmp_path / "out"
    words = ["--plan", "--variants", "full", "hpl", "--seeds", "0", "--samples", "20e6"]
    reproduce.main([*words, "--device", "cpu", "--out", str(out)])
    assert not out.exists()
    said = capsys.readouterr().out
    # 3,256 x 6,144 = 20.0 M samples: 122.9 s at 162,786 samples/s; two rows are 40.0 M
    assert "full-seed0       3,256   20.0 M" in said and "2 rows" in said and "40.0 M" in said
    assert "162,786 samples/s, measured for the full network on mixed" in said
    assert "evaluation comes on top; none has been measured here yet" in said
