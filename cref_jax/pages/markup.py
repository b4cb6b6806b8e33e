"""Building blocks of a self-contained HTML page without network access or scripts.

All text passes through `escape`, so that no name or setting becomes markup. Only `Html` passes
unchanged, and only the functions of this module create it. A content security policy in the page's
head blocks scripts and external content in case one of them fails.
"""

import base64
import contextlib
import html
import io
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from cref_jax.errors import ConfigError

MEGABYTE = 1_000_000  # bytes
MOST_PICTURE = 8 * MEGABYTE  # bytes per file; assumed: far above any still of this program
MOST_VIDEO = 6 * MEGABYTE  # bytes per file; assumed: with it a page still opens within 3 s
LARGE_PICTURE = MEGABYTE // 4  # bytes; a larger one is embedded with losses that nobody sees
QUALITY = 85  # of WebP, up to 100
CHART = (4.6, 2.7)  # inches: readable on a phone, and two fit side by side on a screen
MISSING = "-"  # shown for an unknown number

SIGNATURES = {  # suffix: media type, then offset and bytes of the signature in the file
    ".png": ("image/png", 0, b"\x89PNG\r\n\x1a\n"),
    ".mp4": ("video/mp4", 4, b"ftyp"),
}
POLICY = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"
CHART_STYLE = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 10,
    "font.family": "DejaVu Sans",  # comes with matplotlib
    "font.size": 9,
    "grid.alpha": 0.3,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "svg.fonttype": "path",  # glyphs as outlines: no dependence on installed fonts
    "svg.hashsalt": "cref_jax",  # equal charts give equal bytes
    "text.parse_math": False,  # a name with two dollar signs is not a formula
}
STYLE = """
:root { color-scheme: light dark; --ink: #1d2129; --faint: #5c6470; --paper: #fff;
  --card: #f4f5f7; --line: #d9dce1; --link: #0b57a8; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e6ea; --faint: #a2a9b4;
  --paper: #16181d; --card: #22252c; --line: #3a3f48; --link: #8ab8f0; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem 1rem 3rem; max-width: 72rem; background: var(--paper);
  color: var(--ink); font: 16px/1.5 system-ui, sans-serif; overflow-wrap: break-word; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0.6rem 0; }
h2 { font-size: 1.3rem; margin: 2.4rem 0 0.6rem; padding-top: 0.6rem;
  border-top: 1px solid var(--line); }
h3 { font-size: 1.05rem; margin: 1.6rem 0 0.4rem; }
p { max-width: 46rem; margin: 0.5rem 0; }
a { color: var(--link); }
nav { display: flex; flex-wrap: wrap; gap: 0.2rem 1.2rem; margin: 0.8rem 0; }
code { font: 0.9em ui-monospace, monospace; background: var(--card); padding: 0.1em 0.3em;
  border-radius: 3px; overflow-wrap: anywhere; }
.faint, footer, figcaption, caption { color: var(--faint); font-size: 0.9rem; }
.note { border-left: 3px solid var(--line); padding-left: 0.8rem; color: var(--faint); }
.tiles { display: flex; flex-wrap: wrap; gap: 0.8rem; margin: 1rem 0; }
.tiles div { background: var(--card); border-radius: 8px; padding: 0.6rem 1rem;
  flex: 1 1 9rem; max-width: 22rem; }
.tiles b { display: block; white-space: nowrap; font-size: 1.4rem; line-height: 1.3; }
.tiles span { color: var(--faint); font-size: 0.9rem; }
.scroll { overflow-x: auto; margin: 0.6rem 0; }
table { width: max-content; border-collapse: collapse; font-size: 0.92rem;
  font-variant-numeric: tabular-nums; }
caption { text-align: left; padding: 0.2rem 0; }
th, td { padding: 0.25rem 0.7rem 0.25rem 0; text-align: left; vertical-align: top;
  border-bottom: 1px solid var(--line); }
td { max-width: 36rem; }
thead th { vertical-align: bottom; max-width: 8rem; font-size: 0.92em; color: var(--faint); }
tbody th { font-weight: 500; white-space: nowrap; }
.number { text-align: right; }
td.number { white-space: nowrap; }
dl { display: grid; grid-template-columns: fit-content(45%) minmax(0, 1fr);
  gap: 0.2rem 1.2rem; margin: 0.6rem 0; }
dt { color: var(--faint); }
dd { margin: 0; }
.charts { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(21rem, 100%), 1fr));
  gap: 0.8rem; margin: 0.8rem 0; }
.wide { grid-template-columns: repeat(auto-fill, minmax(min(24rem, 100%), 1fr)); }
figure { margin: 0; min-width: 0; }
figure img { background: #fff; border-radius: 6px; padding: 6px; max-width: 100%; height: auto; }
.charts img { width: 100%; border: 1px solid var(--line); }
.media { margin: 1rem 0; }
.media img { padding: 0; }
video { width: 100%; max-width: 60rem; border-radius: 6px; background: #000; }
details { margin: 0.8rem 0; }
summary { cursor: pointer; color: var(--link); }
@media print { :root { --ink: #000; --paper: #fff; --card: #fff; --line: #bbb; --faint: #444;
  --link: #000; } body { max-width: none; font-size: 10pt; }
  nav { display: none; } figure, tr, .tiles div { break-inside: avoid; }
  h2, h3 { break-after: avoid; } .scroll { overflow: visible; }
  table { width: auto; font-size: 8pt; }
  details::details-content { content-visibility: visible; block-size: auto; } }
"""


class Html(str):
    """Markup, as opposed to text that still has to be escaped."""


class Column(NamedTuple):
    """A column heading; numbers are aligned right."""

    title: str
    number: bool = False


class Section(NamedTuple):
    """A part of a page, with its heading."""

    title: str
    body: Html


def escape(text: str) -> Html:
    """Escape text; `Html` is returned unchanged."""
    if isinstance(text, Html):
        return text
    shown = text.encode("utf-8", "replace").decode()  # file names may not be valid Unicode
    return Html(html.escape(shown))


def join(*parts: str) -> Html:
    """Concatenate parts, escaping plain text."""
    return Html("".join(escape(part) for part in parts))


def element(name: str, *content: str, **attributes: str) -> Html:
    """Build an element; the attribute `class` is passed as `class_`."""
    shown = "".join(f' {key.rstrip("_")}="{escape(v)}"' for key, v in attributes.items())
    return Html(f"<{name}{shown}>{join(*content)}</{name}>")


def paragraph(*content: str) -> Html:
    """Build a paragraph."""
    return element("p", *content)


def code(text: str) -> Html:
    """Build inline code."""
    return element("code", text)


def note(*content: str) -> Html:
    """Build a note, for example on missing data and the command that creates it."""
    return element("p", *content, class_="note")


def tiles(values: Iterable[tuple[str, str]]) -> Html:
    """Build tiles, each a headline figure above its label."""
    each = [element("div", element("b", value), element("span", label)) for value, label in values]
    return element("div", *each, class_="tiles") if each else Html()


def definition_list(values: Iterable[tuple[str, str]]) -> Html:
    """Build a list of names and their values."""
    return element("dl", *(join(element("dt", k), element("dd", v)) for k, v in values))


def table(columns: Sequence[Column], rows: Iterable[Sequence[str]], caption: str = "") -> Html:
    """Build a table that scrolls sideways if too wide; the first cell of a row is its heading."""
    kinds = ["number" if column.number else "" for column in columns]
    cell = lambda name, text, kind, **more: (
        element(name, text, class_=kind, **more) if kind else element(name, text, **more)
    )
    head = [cell("th", c.title, k, scope="col") for c, k in zip(columns, kinds, strict=True)]
    body = []
    for row in rows:
        first, *rest = zip(row, kinds, strict=True)
        cells = [cell("td", text, kind) for text, kind in rest]
        body.append(element("tr", cell("th", *first, scope="row"), *cells))
    return element(
        "div",
        element(
            "table",
            *([element("caption", caption)] if caption else []),
            element("thead", element("tr", *head)),
            element("tbody", *body),
        ),
        class_="scroll",
    )


def collapsible(summary: str, *content: str) -> Html:
    """Build content that is collapsed until clicked."""
    return element("details", element("summary", summary), *content)


def subsections(sections: Iterable[Section]) -> Html:
    """Build the subsections of a section."""
    return join(*(join(element("h3", title), body) for title, body in sections))


def charts(*plots: Html) -> Html:
    """Lay charts out side by side, as many per row as fit."""
    return element("div", *plots, class_="charts")


def wide_charts(*plots: Html) -> Html:
    """Lay out charts with many rows, larger than those of `charts`."""
    return element("div", *plots, class_="charts wide")


def chart(
    paint: Callable[[Axes], None], alt: str, caption: str = "", size: tuple[float, float] = CHART
) -> Html:
    """Render the figure that `paint` draws on a single Axes; `size` in inches.

    Each chart is a separate image, so that the element ids of two charts cannot clash.
    """
    with matplotlib.rc_context(CHART_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        paint(figure.subplots())
        file = io.StringIO()
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(file, format="svg", metadata=nothing)
    # 0.01 pt is finer than a screen pixel and halves the size
    short = re.sub(r"[ML] -?[\d.]+ -?[\d.]+ ", _round_numbers, file.getvalue())
    return _image("image/svg+xml", short.encode(), alt, caption)


def media(path: Path, most: int | None = None) -> Html:
    """Embed an image or a video, or return a note if it is too large or unreadable.

    `most` is the size limit in bytes; the default is the limit of the file type.
    """
    kind, place, signature = SIGNATURES[path.suffix.lower()]
    is_video = kind.startswith("video")
    most = (MOST_VIDEO if is_video else MOST_PICTURE) if most is None else most
    try:
        size = path.stat().st_size
        if size > most:
            return note(
                code(path.name),
                f" ({size / MEGABYTE:.1f} MB) is left out: it exceeds the limit of "
                f"{most / MEGABYTE:.1f} MB. It is in {path.parent}.",
            )
        content = path.read_bytes()
    except OSError as error:
        return note(code(path.name), f" cannot be read: {error.strerror}.")
    if content[place : place + len(signature)] != signature:
        return note(code(path.name), f" is not a valid {path.suffix.lower()[1:]} file.")
    if not is_video:
        kind, content = _compress(kind, content)
        return element("div", _image(kind, content, path.name, path.name), class_="media")
    shown = element("video", controls="", preload="metadata", src=_data_url(kind, content))
    return element(
        "div",
        element("figure", shown, element("figcaption", path.name)),
        class_="media",
    )


def document(title: str, lead: str, sections: Sequence[Section], foot: str = "") -> str:
    """Assemble the page: title, `lead`, links to the sections, the sections and `foot`."""
    links = [element("a", s.title, href=f"#part{k}") for k, s in enumerate(sections)]
    bodies = [
        element("section", element("h2", s.title), s.body, id=f"part{k}")
        for k, s in enumerate(sections)
    ]
    head = join(
        Html('<meta charset="utf-8">'),
        Html(f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'),
        Html('<meta name="viewport" content="width=device-width, initial-scale=1">'),
        Html('<link rel="icon" href="data:,">'),
        element("title", title),
        Html(f"<style>{STYLE}</style>"),
    )
    body = join(
        element("header", element("h1", title), lead, element("nav", *links)),
        element("main", *bodies),
        element("footer", paragraph(foot)) if foot else Html(),
    )
    return f'<!doctype html>\n<html lang="en">\n<head>{head}</head>\n<body>{body}</body>\n</html>\n'


def check_name(out: Path) -> None:
    """Check that the file name ends in .html.

    Raises:
        ConfigError: it does not.
    """
    if out.suffix != ".html":
        raise ConfigError(f"the name of a page must end in .html: {out}")


def write(out: Path, document: str) -> None:
    """Write the page atomically.

    Raises:
        ConfigError: the name does not end in .html, or the file cannot be written.
    """
    check_name(out)
    part = out.with_suffix(".part")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(document, encoding="utf-8")
        part.replace(out)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink()
        raise ConfigError(f"cannot write {out}: {error.strerror}") from None


def _compress(kind: str, content: bytes) -> tuple[str, bytes]:
    """Compress a large picture; return its media type and bytes, its own where that is no gain."""
    if len(content) <= LARGE_PICTURE:
        return kind, content
    file = io.BytesIO()
    try:
        Image.open(io.BytesIO(content)).save(file, "webp", quality=QUALITY)
    except (
        OSError,
        ValueError,
        Image.DecompressionBombError,
    ):  # a damaged one is shown as far as a browser can
        return kind, content
    smaller = file.getvalue()
    return ("image/webp", smaller) if len(smaller) < len(content) else (kind, content)


def _round_numbers(point: re.Match[str]) -> str:
    return re.sub(r"\d+\.\d{3,}", lambda number: f"{float(number[0]):.2f}", point[0])


def _data_url(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _image(kind: str, content: bytes, alt: str, caption: str) -> Html:
    shown = Html(f'<img alt="{escape(alt)}" src="{_data_url(kind, content)}">')
    return element("figure", shown, *([element("figcaption", caption)] if caption else []))
