"""The documentation: links lead somewhere, commands parse, and quoted errors are the program's."""

import importlib
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import tyro

from cref_jax.config.folders import data_folder

ROOT = Path(__file__).parents[1]
PAGES = sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("experiments/*.md")})
OF_USE = [page for page in PAGES if page.name != "CHANGELOG.md"]  # that one tells of the past
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
TARGETS = dict(re.findall(r"^([a-z0-9-]+):.*## (.*)$", MAKEFILE, re.MULTILINE))
OF_TESTS = ("test", "test-fast")  # their ARGS are pytest's
WRITTEN = {
    "wide",
    "mine",
    "mine.toml",
    "yard.npy",
}  # terrains and experiments that the reader writes
PLACEHOLDER = re.compile(r"\bNAME\b|<")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_to_a_file_and_a_heading(page: Path):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"\w+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = page.parent / name if name else page
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", OF_USE, ids=lambda page: page.name)
def test_every_command_parses(page: Path):
    for target, words in commands(page):
        assert target in TARGETS, words
        settings = dict(word.split("=", 1) for word in words if re.match(r"[A-Z_]+=", word))
        assert settings.keys() <= {"TERRAIN", "EXP", "ARGS", "PYTHON"}, words
        check_name("terrains", settings.get("TERRAIN", "flat"))
        check_name("experiments", settings.get("EXP", "smoke"))
        arguments = shlex.split(settings.get("ARGS", ""))
        if target not in OF_TESTS and arguments:
            parse(target.replace("-", "_"), arguments)


def test_a_command_that_does_not_parse_is_found():
    """Else the test above could not fail."""
    with pytest.raises(SystemExit):
        parse("eval", ["--num-env", "10"])
    with pytest.raises(AssertionError):
        check_name("terrains", "gaps")


def commands(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Find `make TARGET ...` and `python -m cref_jax.NAME ...`, the latter as the same `make`."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = re.findall(
        r"^ {4}([^\n]*)$|^```\w*\n(.*?)^```|`([^`\n]+)`", text, re.MULTILINE | re.DOTALL
    )
    for line in "\n".join("".join(found) for found in lines).splitlines():
        if found := re.match(r"make ([a-z][a-z0-9-]*)(.*)$", line.strip()):
            if not PLACEHOLDER.search(line) and "  " not in found[2].partition("#")[0].rstrip():
                yield found[1], shlex.split(found[2], comments=True)
        elif found := re.search(r"-m cref_jax\.(?!deploy)(\w+)([^;&|\"\[\]]*)", line):
            yield found[1].replace("_", "-"), [f"ARGS={found[2].replace('$i', '0')}"]


def check_name(folder: str, name: str) -> None:
    assert name in WRITTEN or (data_folder(folder) / f"{name}.toml").exists(), name


def parse(name: str, arguments: list[str]) -> None:
    module = importlib.import_module(f"cref_jax.{name}")
    tyro.cli(module.Command if name == "train" else module.Options, args=arguments)


def test_the_errors_of_troubleshooting_are_those_of_the_program():
    page = (ROOT / "docs/troubleshooting.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([^|]*`[^|]*)\|", page, re.MULTILINE)
    quoted = [text for row in rows for text in re.findall(r"`([^`]+)`", row)]
    parts = [part.strip() for text in quoted for part in text.split("...") if part.strip(", ")]
    sources = [file.read_text(encoding="utf-8") for file in (ROOT / "cref_jax").rglob("*.py")]
    source = "\n".join([MAKEFILE, *sources])
    program = re.sub(r'"\s*\n\s*f?"', "", source)  # as adjacent literals are joined
    assert [part for part in parts if part not in program] == []
    assert len(parts) > 10
