"""Every number of an evaluation stands on its page."""

import os
import shutil
import subprocess

import eval_records
import pytest
from html_reader import leaves, read

from cref_jax.errors import ConfigError
from cref_jax.pages import evaluation_charts, evaluation_page

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)


def written(record, tmp_path):
    evaluation_page.write(record, tmp_path / "evaluation.html")
    return read(tmp_path / "evaluation.html")


def row(seen, *cells):
    """Return the first row that begins with these cells."""
    return next(r for r in seen.rows if r[: len(cells)] == list(cells))


@pytest.mark.parametrize("policies", [1, 3])
def test_every_cell_and_number_of_a_table_is_shown(tmp_path, policies):
    record = eval_records.table(policies)
    seen = written(record, tmp_path)
    assert leaves(seen) == []
    for cell in record["cells"]:
        shown = row(seen, cell["kind"], cell["level"])
        expected = [
            f"{100 * cell['size_m']:.0f} cm",
            f"{cell['successes']} of {cell['trials']}",
            f"{100 * cell['rate']:.1f} %",
            f"{100 * cell['wilson_low']:.1f} to {100 * cell['wilson_high']:.1f} %",
            f"{100 * cell['paper']['rate']:.2f} %",
        ]
        assert shown[2:7] == expected
        name = f"{cell['kind']} {cell['level']}, {expected[0]}"
        causes = [str(n) for n in cell["failures"].values()]
        assert row(seen, name) == [name, str(cell["trials"]), *causes]
        for b in cell["by_speed"]:
            speed = f"{b['low']:.1f} to {b['high']:.1f} m/s"
            assert row(seen, name, speed)[2:4] == [str(b["trials"]), str(b["successes"])]
        if cell["up_failures"] is not None:
            up_down = [name, str(cell["up_failures"]), str(cell["down_failures"])]
            assert row(seen, *up_down)[3] == str(cell["trials"])
        if policies > 1:
            each = ", ".join(f"{100 * rate:.1f}" for rate in cell["by_policy"])
            assert shown[8:] == [each, "1.3"]
    for policy in record["policies"]:
        assert policy["digest"] in seen.text and policy["source"] in seen.text
    for words in ("412.3 s", "1 x cpu", "jax 0.10.2", record["rule"]):
        assert words in seen.text


def test_the_head_says_the_overall_rate_its_interval_and_how_far_the_paper_is(tmp_path):
    # 0.613 against 0.9046: 29.16 points; 0.704 against 0.9811: 27.71; 0.305 against 0.675: 37.0
    text = written(eval_records.table(), tmp_path).text
    assert "61.3 %of the trials succeed, over all cells (95 % interval 59.2 to 63.4 %)" in text
    assert "29.2 points lower than the paper's 90.46 %" in text
    assert "27.7 points lower than the paper's 98.11 %" in text
    assert "37.0 points lower than the paper's 67.50 %" in text


def test_a_difference_is_said_in_words(tmp_path):
    # gap easy: 0.96 - 0.993 = -3.3 points; gap ood: 0.195 - 0.447 = -25.2 points
    record = eval_records.table()
    record["cells"][0]["paper"] |= {"difference": 0.021, "significant": True}
    seen = written(record, tmp_path)
    assert row(seen, "gap", "easy")[7] == "3.3 points lower, within chance"
    assert row(seen, "gap", "ood")[7] == "25.2 points lower, beyond chance"
    assert row(seen, "stairs", "easy")[7] == "2.1 points higher, beyond chance"


def test_how_much_the_intervals_leave_open_is_said(tmp_path):
    # narrowest: stairs easy, 0.954 to 1.0, half of it 2.3; widest: platform, (0.033 + 0.027) / 2
    text = written(eval_records.table(), tmp_path).text
    assert "With 200 trials per cell, the 95 % intervals (Wilson) extend 2.3 to 3.0 points" in text
    assert "The paper has 2000 trials per cell." in text


@pytest.mark.parametrize(
    ("key", "gone"),
    [
        ("by_speed", "Success by commanded speed"),
        ("up_failures", "Failures on the way up and down"),
        ("paper", "The paper has"),
        ("by_policy", "spread, points"),
        ("failures", "tilted too far"),
    ],
)
def test_what_a_cell_lacks_is_left_out_and_the_rest_is_shown(tmp_path, key, gone):
    record = eval_records.table(3)
    assert gone in written(record, tmp_path).text
    for cell in record["cells"]:
        del cell[key]
    seen = written(record, tmp_path)
    assert gone not in seen.text
    assert row(seen, "gap", "hard")[3] == "124 of 200"


@pytest.mark.parametrize("key", ["overall", "policies", "versions", "rule", "seconds", "device"])
def test_what_a_record_lacks_is_left_out(tmp_path, key):
    record = eval_records.table()
    del record[key]
    assert row(written(record, tmp_path), "gap", "hard")[3] == "124 of 200"


def test_every_scene_and_condition_is_shown(tmp_path):
    record = eval_records.ood()
    seen = written(record, tmp_path)
    assert "4 of 6scenes passed" in seen.text
    for scene in record["scenes"]:
        shown = row(seen, scene["title"], str(scene["trials"]))
        assert shown[2:4] == [str(scene["successes"]), f"{100 * scene['rate']:.1f} %"]
        causes = [str(n) for n in scene["failures"].values()]
        assert [scene["title"], str(scene["trials"]), *causes] in seen.rows
    # 41 of 80 is 51.25 %
    assert row(seen, "frames dropped", "30 %")[2:] == ["80", "41", "51.2 %", "4"]


def test_how_far_robots_come_off_their_way_is_shown(tmp_path):
    seen = written(eval_records.table(), tmp_path)
    assert row(seen, "gap hard, 75 cm", "11 cm")[1:] == ["11 cm", "24 cm", "57 cm"]
    seen = written(eval_records.ood(), tmp_path)
    assert row(seen, "Pallets with slots of 3 cm", "13 cm")[1:] == ["13 cm", "32 cm", "68 cm"]
    assert row(written(eval_records.WALK, tmp_path), "flat ground")[1:] == [
        "14 cm",
        "26 cm",
        "38 cm",
    ]


def test_success_with_each_part_alone_is_shown(tmp_path):
    part = {"kind": "gap", "level": "medium", "size_m": 0.5, "trials": 50, "successes": 41}
    rows = [part | {"part": "pushes", "rate": 0.82}, part | {"part": "noise", "rate": 0.96}]
    seen = written(eval_records.table() | {"suite": "robust", "parts": rows}, tmp_path)
    assert "Success under full randomisation" in seen.text
    assert row(seen, "pushes") == ["pushes", "82.0 %"]
    assert row(seen, "noise") == ["noise", "96.0 %"]


def test_how_commands_are_obeyed_is_shown(tmp_path):
    seen = written(eval_records.COMMANDS, tmp_path)
    assert "33 of 40commanded to stand, move less than 5 cm" in seen.text
    assert "29 of 40commanded to stand, take no step" in seen.text
    assert "42 cmstopping distance" in seen.text
    stand = row(seen, "0.00, 0.00, 0.00")
    assert stand[1:] == ["0.01, -0.00, 0.02", "0.01, 0.01, 0.02", "1 of 40", "16.0 %, 17.0 %"]
    assert row(seen, "0.60, 0.00, 0.00")[3] == "40 of 40"


def test_the_records_of_one_kind_are_shown(tmp_path):
    walk = written(eval_records.WALK, tmp_path).text
    assert "197 of 200episodes without a fall" in walk and "0.0936 m/s" in walk
    assert "0.343, 0.312" in walk and "pelvis too low1" in walk
    pooled = {"wilson_low": 0.957, "wilson_high": 0.995, "fell_by_policy": [0, 3]}
    walk = written(eval_records.WALK | pooled, tmp_path).text
    assert "a fall (95 % interval 95.7 to 99.5 %)" in walk and "of them, by policy0, 3" in walk
    cross = written(eval_records.CROSS, tmp_path).text
    assert "Crossing obstacles: gap, 30 cm" in cross and "95.5 %of 200 trials" in cross
    assert "mean time per success20.1 s" in cross
    slope = written(eval_records.CROSS | {"kind": "slope"}, tmp_path).text
    assert "Crossing obstacles: slope, 30 %" in slope and "obstacle size30 %" in slope


@pytest.mark.parametrize("seconds", [None, float("nan")])  # as written today, and before
def test_where_nobody_succeeds_no_time_is_shown(tmp_path, seconds):
    cross = written(eval_records.CROSS | {"successes": 0, "seconds": seconds}, tmp_path).text
    assert "0.0 %of 200 trials" in cross and "time per success" not in cross


@pytest.mark.parametrize(
    "record",
    [
        {"suite": "table", "cells": 7},
        {"suite": "table", "cells": [{"kind": "gap"}]},
        {"suite": "ood", "scenes": ["a"]},
        {"suite": "walk"},
        {"suite": "cross", "trials": "many", "successes": 3, "kind": "gap"},
    ],
)
def test_a_record_of_another_form_is_one_line(tmp_path, record):
    with pytest.raises(ConfigError, match="has an unknown form"):
        evaluation_page.write(record, tmp_path / "a.html")
    assert not (tmp_path / "a.html").exists()


def test_names_with_markup_or_formulas_are_shown_as_they_are(tmp_path):
    record = eval_records.table()
    record["cells"][3] |= {"kind": "<u>$x^$", "level": "$\\frac$"}
    record["policies"][0]["name"] = "<script>"
    seen = written(record, tmp_path)
    assert row(seen, "<u>$x^$", "$\\frac$")[2] == "23 cm"
    assert not {"u", "script"} & set(seen.tags)


def test_a_cause_that_is_new_has_its_own_name():
    failures = [evaluation_charts.FailureCounts("gap", 10, {"struck by lightning": 2})]
    assert "<img" in evaluation_charts.failure_chart(failures)
    assert evaluation_charts.display_name("struck by lightning") == "struck by lightning"


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
def test_a_browser_shows_the_cells_and_has_nothing_to_complain_about(tmp_path):
    def shown(path):
        command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"]
        command += ["--enable-logging=stderr", f"--user-data-dir={tmp_path / 'profile'}"]
        out = subprocess.run(
            [*command, path.as_uri()],
            capture_output=True,
            text=True,
            timeout=60,
            env={**os.environ, "HOME": str(tmp_path)},
        )
        return out.stdout, [line for line in out.stderr.splitlines() if "CONSOLE" in line]

    path = tmp_path / "evaluation.html"
    record = eval_records.table(3)
    evaluation_page.write(record, path)
    dom, complaints = shown(path)
    assert complaints == []
    for cell in record["cells"]:
        assert f"{cell['successes']} of {cell['trials']}" in dom
    # the page's own policy stops what would leave it, and the browser says so
    path.write_text(path.read_text().replace("<main>", '<main><img src="http://127.0.0.1:9/x">'))
    assert "violates" in " ".join(shown(path)[1])


def test_the_gate_of_every_state_is_shown(tmp_path):
    rows = [
        {"group": "phase", "state": "flight", "n": 1234, "robots": 9, "mean": 0.4126, "q25": 0.3,
         "median": 0.41, "q75": 0.5},
        {"group": "posture", "state": "risky", "n": 0, "robots": 0, "mean": None, "q25": None,
         "median": None, "q75": None},
    ]  # fmt: skip
    seen = written({"suite": "gate", "rule": "the rule", "gate": rows}, tmp_path)
    expected = ["phase", "flight", "1,234", "9", "0.413", "0.410", "0.300 to 0.500"]
    assert row(seen, "phase") == expected
    assert row(seen, "posture") == ["posture", "risky", "0", "0", "-", "-", "-"]
