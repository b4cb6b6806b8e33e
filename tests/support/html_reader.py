"""A page as a browser takes it apart."""

from html.parser import HTMLParser
from pathlib import Path

VOID = {"meta", "link", "img", "br"}
REFERENCES = ("src", "href", "srcset", "poster", "action", "data", "background", "xlink:href")


class Page(HTMLParser):
    """The tags, the references and the text of a page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.references: list[str] = []
        self.words: list[str] = []
        self.rows: list[list[str]] = []
        self.alone: list[str] = []  # tags that are open, and at the end those never closed
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.references += [value or "" for name, value in attrs if name in REFERENCES]
        assert not [name for name, _ in attrs if name.startswith("on")], "a script in an attribute"
        if tag not in VOID:
            self.alone.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.alone.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" in self.alone:
            return
        self.words.append(data)
        if {"td", "th"} & set(self.alone):
            self.rows[-1][-1] += data

    @property
    def text(self) -> str:
        return "".join(self.words)


def read(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


def leaves(page: Page) -> list[str]:
    """Return the references that lead out of the page."""
    return [r for r in page.references if not r.startswith(("data:", "#"))]
