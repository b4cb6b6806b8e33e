"""What is asked with everything randomised and with each part alone, and how it is counted."""

import numpy as np
import pytest
import small_world

from cref_jax import ppo
from cref_jax.config import Randomisation
from cref_jax.env.state import Spread
from cref_jax.evaluation import protocol, robustness_suite
from cref_jax.evaluation.robustness_suite import DEPTH, EVERYTHING, PARTS, STRUCTURES
from cref_jax.evaluation.trials import Walk
from cref_jax.evaluation.witness import Witness


@pytest.fixture(scope="module")
def world():
    return robustness_suite.row_world(small_world.C, small_world.world().physics)


def test_every_cell_is_asked_with_everything_and_each_part_on_each_kind():
    rows = robustness_suite.list_rows()
    whole = [row for row in rows if row.part == EVERYTHING]
    assert len(whole) == 14 and len(rows) == 14 + 10 * 4
    sizes = {(row.kind, robustness_suite.obstacle_size(row.kind, row.level)) for row in whole}
    assert {("gap", 0.90), ("platform", 0.45), ("stairs", 0.23)} < sizes
    for part in PARTS:
        assert [row.kind for row in rows if row.part == part] == [
            "flat", "stairs", "gap", "platform",
        ]  # fmt: skip


def test_the_ranges_are_the_projects_own_whatever_a_policy_was_trained_with(world):
    ranges = Randomisation(structures=8, push_yaw_rate=1.0, **protocol.DEPTH_FAULTS)
    assert world.config.randomisation == ranges and ranges.enabled and not ranges.ramp


def test_a_row_is_tried_on_lanes_of_its_size(world, monkeypatch):
    seen = {}

    def run(w, walker, asked, seed, block, ended, look):
        for trial in range(len(asked.number)):
            look(trial, Walk(np.zeros((2, 7)), np.zeros((2, 2), bool), "low"))
        ranges = w.config.randomisation
        seen[ranges.structures, ranges.depth_holes > 0.0, ranges.camera_pitch] = asked
        one = np.ones(len(asked.number), np.float32)
        ending = (asked.number % 2).astype(int)
        return robustness_suite.Trials(one, ending, one, one, one, one)

    monkeypatch.setattr(robustness_suite.trials, "run", run)
    saw = Witness()
    found = robustness_suite.run_rows(world, ppo.TrainState(*5 * [None]), 10, 0, witness=saw)
    # twelve cells, a longer gap and a higher box, with everything randomised
    assert [failure.failures for failure in saw.worst(99)] == [10] * 14
    place = dict.fromkeys(seen, 0)
    for k, row in enumerate(robustness_suite.list_rows()):
        world_of = (0, False, 2.0)
        if row.part in (EVERYTHING, STRUCTURES):
            world_of = (8, True, 2.0)
        elif row.part == DEPTH:
            world_of = (0, True, 0.0)  # without errors of the mount, which `camera` spreads, too
        asked, first = seen[world_of], place[world_of]
        part, place[world_of] = slice(first, first + 10), first + 10
        names = {world.lanes.kinds[kind] for kind in asked.kind[part]}
        assert names == set(robustness_suite.LANES[row.kind])
        sizes = world.lanes.sizes[asked.level[part], asked.kind[part]]
        np.testing.assert_allclose(sizes, robustness_suite.obstacle_size(row.kind, row.level))
        shares = {name: set(of[part].tolist()) for name, of in asked.spread._asdict().items()}
        on = {name for name, share in shares.items() if share == {1.0}}
        alone = {DEPTH: {"camera"}, STRUCTURES: set()}.get(row.part, {row.part})
        assert on == (set(Spread._fields) if row.part == EVERYTHING else alone)
        assert all(share in ({0.0}, {1.0}) for share in shares.values())
        np.testing.assert_array_equal(asked.number[part], np.arange(10))
        assert (found[k]["part"], found[k]["trials"], found[k]["successes"]) == (row.part, 10, 5)
    assert robustness_suite.overall(found)["rate"] == 0.5
    assert "gap 90 cm" in str(robustness_suite.to_table(found).columns[0]._cells)
