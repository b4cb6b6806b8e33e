import math

import pytest
from rich.console import Console

from cref_jax import sim2sim
from cref_jax.evaluation import sim2sim_table
from cref_jax.evaluation.crossing import LaneResult


def crossing(successes: int, trials: int = 50, **by_cause: int) -> LaneResult:
    return LaneResult("gap", 0.3, trials, successes, by_cause, 20.0, 0.6)


def shown(*cells: sim2sim_table.CellComparison) -> list[str]:
    console = Console(width=120)
    with console.capture() as capture:
        console.print(sim2sim_table.to_table(cells))
    return capture.get().splitlines()


def test_flat_ground_and_the_twelve_cells_and_stairs_both_ways():
    lanes = sim2sim_table.list_lanes()
    assert list(lanes)[:3] == ["flat", "stairs 10 cm", "stairs 15 cm"]
    assert len(lanes) == 13
    assert lanes["stairs 23 cm"] == (("ascent", 0.23), ("descent", 0.23))
    assert lanes["gap 75 cm"] == (("gap", 0.75),)


def test_kept_is_the_share_of_the_successes_of_the_training_simulation():
    both_ways = sim2sim_table.CellComparison(
        "stairs", (crossing(50), crossing(40)), (crossing(45), crossing(36))
    )
    assert both_ways.kept_share == pytest.approx(81 / 90)
    assert math.isnan(
        sim2sim_table.CellComparison("gap", (crossing(0),), (crossing(1),)).kept_share
    )


def test_a_cell_says_both_counts_in_a_line():
    cell = sim2sim_table.CellComparison(
        "stairs", (crossing(50), crossing(40)), (crossing(45), crossing(36))
    )
    assert cell.line() == "  training simulation 90 of 100, whole robot 81 of 100"


def test_the_table_pools_both_ways_with_an_interval_and_causes():
    row = shown(
        sim2sim_table.CellComparison(
            "stairs 20 cm",
            (crossing(50), crossing(40)),
            (crossing(45, low=5), crossing(36, low=10, hit=4, late=0)),
        )
    )[1]
    # Wilson's interval of 81 of 100: 72.2 to 87.5 %
    expected = "stairs 20 cm 100 90.0 81.0 72-87 0.90 15 low, 4 hit"
    assert " ".join(row.split()) == expected


def test_where_training_never_succeeds_there_is_no_share():
    row = shown(sim2sim_table.CellComparison("gap 80 cm", (crossing(0),), (crossing(0, low=50),)))[
        1
    ]
    assert row.split() == ["gap", "80", "cm", "50", "0.0", "0.0", "0-7", "50", "low"]


def test_a_film_is_of_one_kind_of_lane(capsys):
    with pytest.raises(SystemExit) as stopped:
        sim2sim.main(["--table", "--film", "film.mp4"])
    assert stopped.value.code == 2
    assert "--film goes with one --kind" in capsys.readouterr().err
