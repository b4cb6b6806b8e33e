"""What is asked with everything randomised and with each part alone, and how it is counted."""

import jax
import numpy as np
import pytest
import small_world

from cref_jax import config, ppo
from cref_jax.config import Randomisation
from cref_jax.env import depth_faults, structures
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


def test_structures_alone_are_there_without_faults_and_with_the_camera_where_it_is(world):
    parts = [parts for parts, _ in robustness_suite.WORLDS]
    ranges = dict(robustness_suite.WORLDS[parts.index((STRUCTURES,))][1])
    c = config.override(world.config, {"randomisation": ranges})
    spread = robustness_suite._spread(STRUCTURES)
    states = small_world.fresh_states().replace(
        spread=jax.tree.map(lambda x: np.full(512, x), spread)
    )
    seen = jax.vmap(lambda s: structures.sample_structures(world.replace(config=c), s))(states)
    is_there = np.asarray(seen)[..., 2] > -50.0
    assert 3.5 < is_there.sum(axis=1).mean() < 4.5  # half of eight
    assert not depth_faults.has_faults(c.randomisation) and c.randomisation.camera_pitch == 0.0


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
        # structures and faults of depth without errors of the mount, which `camera` spreads, too
        world_of = {
            EVERYTHING: (8, True, 2.0), STRUCTURES: (8, False, 0.0), DEPTH: (0, True, 0.0)
        }.get(row.part, (0, False, 2.0))  # fmt: skip
        asked, first = seen[world_of], place[world_of]
        part, place[world_of] = slice(first, first + 10), first + 10
        names = {world.lanes.kinds[kind] for kind in asked.kind[part]}
        assert names == set(robustness_suite.LANES[row.kind])
        sizes = world.lanes.sizes[asked.level[part], asked.kind[part]]
        np.testing.assert_allclose(sizes, robustness_suite.obstacle_size(row.kind, row.level))
        shares = {name: set(of[part].tolist()) for name, of in asked.spread._asdict().items()}
        on = {name for name, share in shares.items() if share == {1.0}}
        alone = {"camera"} if row.part in (STRUCTURES, DEPTH) else {row.part}
        assert on == (set(Spread._fields) if row.part == EVERYTHING else alone)
        assert all(share in ({0.0}, {1.0}) for share in shares.values())
        np.testing.assert_array_equal(asked.number[part], np.arange(10))
        assert (found[k]["part"], found[k]["trials"], found[k]["successes"]) == (row.part, 10, 5)
    rate = {"easy": 9, "medium": 6, "hard": 3, "ood": 1, "beyond": 0}  # of 10
    found = [row | {"successes": rate[row["level"]]} for row in found]
    whole = robustness_suite.overall(found)
    # (9 + 6 + 3) / 30, 1 / 10, and three of the first to one of the second
    assert [whole[name] for name in ("trained", "ood", "rate")] == pytest.approx([0.6, 0.1, 0.475])
    assert "gap 90 cm" in str(robustness_suite.to_table(found).columns[0]._cells)
