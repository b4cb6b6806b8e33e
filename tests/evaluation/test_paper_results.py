"""The paper's figures: what is derived follows from what is measured, but for one misprint."""

import pytest

from cref_jax.config import Terrain
from cref_jax.evaluation import paper_results, tables
from cref_jax.terrain import lanes


def test_overall_is_the_plain_mean_of_the_twelve_cells():
    # the sums of Table II's rows, by hand, over twelve
    rows = {
        "Full CReF": (1085.50, 90.46),
        "w/o Cross-Attn": (942.70, 78.56),
        "w/o GRF": (1005.30, 83.78),
        "w/o Highway Gate": (999.50, 83.29),
        "HPL": (893.95, 74.50),
    }
    for name, (total, overall) in rows.items():
        found = paper_results.overall(paper_results.METHODS[name].success)
        assert found == pytest.approx(total / 12.0)
        assert found == pytest.approx(overall, abs=0.0051)


def test_all_twenty_rates_on_stairs_follow_from_the_failures_both_ways():
    entries = [
        (method.success["stairs", level], method.up[level], method.down[level])
        for method in paper_results.METHODS.values()
        for level in paper_results.LEVELS
    ]
    assert len(entries) == 20
    for printed, up, down in entries:
        assert paper_results.stair_success(up, down) == pytest.approx(printed, abs=1e-9)
    assert paper_results.stair_success(93, 438) == pytest.approx(73.45)  # 531 of 2000


def test_one_printed_value_does_not_follow():
    wrong = paper_results.find_misprints()
    assert list(wrong) == ["HPL, overall"]
    printed, found = wrong["HPL, overall"]
    assert printed == 74.57 and round(found, 2) == 74.50


def test_means_of_the_cells_inside_and_outside_of_training():
    success = paper_results.METHODS[paper_results.FULL].success
    inside = [rate for (_, level), rate in success.items() if level != "ood"]
    outside = [rate for (_, level), rate in success.items() if level == "ood"]
    assert sum(inside) / 9 == pytest.approx(98.11, abs=0.005)
    assert sum(outside) / 3 == pytest.approx(67.50, abs=0.005)


def test_the_sizes_are_those_of_table_two():
    cm = {kind: [round(100 * x) for x in of.values()] for kind, of in tables.cell_sizes().items()}
    assert cm == {
        "stairs": [10, 15, 20, 23],
        "gap": [30, 50, 75, 80],
        "platform": [20, 30, 40, 43],
    }
    assert lanes.named_sizes(Terrain(), "stairs_up") == tables.cell_sizes()["stairs"]
