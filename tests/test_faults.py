"""FAULTS.md names tests that exist."""

import re
from pathlib import Path

HERE = Path(__file__).parent


def test_every_test_that_proves_a_fault_exists():
    named = set(re.findall(r"`(test_\w+)`", (HERE / "FAULTS.md").read_text(encoding="utf-8")))
    there = {
        name
        for file in HERE.rglob("test_*.py")
        for name in re.findall(r"^def (test_\w+)", file.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert len(named) > 50 and named <= there, named - there
