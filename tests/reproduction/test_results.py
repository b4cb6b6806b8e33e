"""What several seeds come to, worked by hand, and the page of it."""

import pytest
from fake_commands import gate, table
from html_reader import leaves, read

from cref_jax.pages import reproduction_page
from cref_jax.reproduction import results

SIZES = {"full": {"policy": 1000, "critic": 10}, "hpl": {"policy": 880, "critic": 10}}


def summary(variant="full", lost=(1, 3), mads=(0.03, 0.05), shifts=(0, 10)):
    of = {
        seed: {"table": table(20, *of), "gate": gate(20, shift)}
        for seed, (*of, shift) in enumerate(zip(lost, mads, shifts, strict=True))
    }
    learned = [{"samples": [8, 16], "levels": {"gap": [0.0, level]}} for level in (2.0, 3.0)]
    return {
        **results._summarize_variant(variant, of, 2, SIZES),
        "levels": results._levels(learned),
    }


def test_a_mean_over_two_seeds_and_its_interval():
    # 0.95 and 0.85: deviation 0.1 / sqrt(2), standard error 0.05, Student's t 12.706
    few = results.over_seeds([0.95, 0.85])
    assert few["mean"] == pytest.approx(0.9)
    assert few["deviation"] == pytest.approx(0.0707107)
    assert (few["low"], few["high"]) == pytest.approx((0.9 - 0.63531, 0.9 + 0.63531))
    assert results.over_seeds([0.95, 0.85], 0.0, 1.0)["high"] == 1.0
    assert results.over_seeds([0.5]) == {
        "each": [0.5], "mean": 0.5, "deviation": None, "low": None, "high": None,
    }  # fmt: skip


def test_success_is_the_mean_over_seeds_and_its_trials_are_pooled():
    # the first cell: 1 and 3 of 20 lost; 36 of 40 succeed, Wilson 76.9 to 96.04 %
    first = summary()["success"]["cells"][0]
    assert (first["kind"], first["level"]) == ("stairs", "easy")
    assert first["paper"] == pytest.approx(0.9985)
    assert first["seeds"]["each"] == [0.95, 0.85] and first["trials"] == 40
    assert first["rate"] == pytest.approx(0.9)
    assert first["wilson_low"] == pytest.approx(0.7695, abs=1e-4)
    assert first["wilson_high"] == pytest.approx(0.9604, abs=1e-4)
    # cell n loses n more: 1 + 5.5 and 3 + 5.5 of 20 on average
    whole = summary()["success"]["overall"]
    assert whole["seeds"]["each"] == pytest.approx([0.675, 0.575])
    assert whole["paper"] == pytest.approx(0.9045)


def test_failures_on_stairs_are_shares_of_the_trials_of_a_direction():
    rows = {(row["way"], row["level"]): row for row in summary()["stairs"]}
    # one of ten going up; going down 1 + 2 - 1 = 2 and 3 + 2 - 1 = 4 of ten on hard stairs
    up, down = rows["up", "hard"], rows["down", "hard"]
    assert (up["failures"], up["trials"], up["seeds"]["mean"]) == (2, 20, pytest.approx(0.1))
    assert (down["failures"], down["trials"]) == (6, 20)
    assert down["seeds"]["each"] == pytest.approx([0.2, 0.4])
    assert (up["paper"], down["paper"]) == (0.003, 0.052)  # Table III: 3 and 52 of 1000
    assert rows["down", "ood"]["paper"] == 0.438


def test_of_21_trials_eleven_go_up():
    part = next(results._stairs("full", [table(21, 3)]))
    assert (part["way"], part["trials"]) == ("up", 11)


def test_of_one_trial_none_goes_down_and_the_rate_is_none():
    rows = list(results._stairs("full", [table(1, 0)]))
    up, down = rows[0], rows[4]
    assert (up["trials"], up["rate"]) == (1, 1.0)
    assert (down["way"], down["trials"], down["rate"]) == ("down", 0, None)


def test_touchdowns_are_of_both_feet_on_hard_stairs():
    up, down = summary()["touchdowns"]
    assert down["mad_m"]["each"] == [0.03, 0.05] and down["mad_m"]["mean"] == pytest.approx(0.04)
    assert (up["touchdowns"], down["touchdowns"]) == (80, 120)
    assert (up["paper_m"], down["paper_m"]) == (None, 0.014)
    nobody = results._touchdowns("hpl", [{}], "down")
    assert nobody["touchdowns"] == 0 and nobody["mad_m"]["mean"] is None


def test_the_gate_is_compared_between_the_states_that_the_paper_names():
    found = summary()["gate"]
    # flat, stairs up, stairs down: 0.40, 0.41, 0.42, and 0.01 more with the second seed
    assert found["states"][1]["mean"]["each"] == pytest.approx([0.41, 0.42])
    gaps = {(d["higher"], d["lower"]): d["difference"]["mean"] for d in found["differences"]}
    assert gaps == {
        ("stairs up", "flat"): pytest.approx(0.01),
        ("stairs down", "flat"): pytest.approx(0.02),
        ("flight", "double support"): pytest.approx(-0.02),
        ("risky", "stable"): pytest.approx(0.01),
    }
    never = gate(20)
    never["gate"][0]["mean"] = None  # no step on flat ground
    found = results._gate([never["gate"]])
    assert found and found["differences"][0]["difference"]["mean"] is None
    assert results._gate([]) is None


def test_a_variant_whose_size_differs_by_more_than_a_tenth_is_pointed_out():
    full, hpl = summary(), summary("hpl")
    assert (full["other_size"], hpl["other_size"]) == (False, True)
    assert hpl["parameters_of_full"] == pytest.approx(0.88)


def test_the_page_shows_the_numbers_beside_the_papers_and_says_how_they_differ(tmp_path):
    row = {"row": "full-seed0", "samples": 4_000_000, "planned": 20_000_000, "finished": False}
    row |= {"samples_per_s": 6000.0, "training_s": 666.0, "evaluation_s": 0.0, "variant": "full"}
    row["curves"] = {"samples": [8, 4_000_000], "levels": {"gap": [None, 2.0]}}
    record = {
        "terrain": "mixed", "device": "cpu", "seeds": [0, 1], "trials": 20, "settings": [],
        "samples": 20_000_000, "paper_samples": 2_000_000_000, "paper_trials": 2000,
        "rule": "the rule", "gate_rule": "the other", "rows": [row],
        "variants": [summary(), summary("hpl")],
    }  # fmt: skip
    reproduction_page.write(record, tmp_path / "page.html")
    seen = read(tmp_path / "page.html")
    assert leaves(seen) == []
    rows = {r[0]: r for r in seen.rows}
    tables = [r for r in seen.rows if r[0] == "full, 2 seeds"]
    # means of all and of the first cell, with both intervals
    assert tables[0][2] == "90.0trials 76.9-96.0seeds 26.5-100.0"
    assert rows["paper: Full CReF"][1:3] == ["above 0", "above 0"]
    assert ["paper: Full CReF", "90.45", "99.85"] in [r[:3] for r in seen.rows]
    assert tables[2][4:] == ["4.0 cm (3.0, 5.0; 0.0 to 16.7)", "1.4 cm"]
    assert rows["hpl"][2:] == ["88.0 %", "10", "HPL", "differs from full by more than 10 %"]
    assert rows["full-seed0"][1:4] == ["unfinished: being trained", "4.0 M of 20.0 M", "6,000"]
    # beside each of the five tables of numbers
    note = "20.0 M samples per run, 1 % of the paper's; the paper has 2 billion (2,000.0 M)"
    assert seen.text.count(note) == 5
    # levels 2 and 3: standard error 0.5, Student's t 12.706, and no level is below 0
    assert ["full, 2 seeds", "2.5 (2.0, 3.0; 0.0 to 8.9)"] in seen.rows
