"""Pictures of walks on the evaluation page: gaits, touchdowns on stairs, films of failures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from cref_jax.pages import evaluation_charts, markup
from cref_jax.pages.markup import MISSING, Column, Html, Section, element, join, note, paragraph
from cref_jax.terrain import generators

Record = Mapping[str, Any]

FEET = {"left": "#f2731a", "right": "#1aa64c"}  # as the marks of films
EDGE = "#5c6470"
MOST_FILM = 2 * markup.MEGABYTE  # bytes per film of a failure; assumed: ten times one of 6 s
NAMES = {"ascent": "flight up", "descent": "flight down"}  # of kinds of lane
PAPER_MAD = 1.4  # cm, in descent, Sec. III-B


def gait_body(walks: Sequence[Record]) -> Html:
    """Build the section of gaits: when each foot bears, stride and time in the air."""
    columns = [Column("walk"), Column("stride", True)]
    columns += [Column(f"{foot} foot in the air", True) for foot in FEET]
    rows = [
        (_lane_name(walk), _seconds(walk["stride_s"]), *(_percent(x) for x in walk["airborne"]))
        for walk in walks
    ]
    text = (
        "One trial of each kind, without noise. A bar: the foot is on the ground. A stride is the "
        "time between touchdowns of the same foot; stride and shares are those of the whole trial."
    )
    chart = markup.wide_charts(gait_chart(walks))
    return join(paragraph(text), chart, markup.table(columns, rows))


def gait_chart(walks: Sequence[Record]) -> Html:
    """Draw the contacts of both feet over time, two rows per walk."""

    def paint(axis: Axes) -> None:
        for k, walk in enumerate(walks):
            for row, (foot, colour) in enumerate(FEET.items()):
                spans = [(start, end - start) for start, end in walk["contacts"][row]]
                label = f"{foot} foot on the ground" if k == 0 else None
                axis.broken_barh(
                    spans, (k - 0.4 + 0.41 * row, 0.37), color=colour, lw=0, label=label
                )
        axis.set_yticks(range(len(walks)), [_lane_name(walk) for walk in walks])
        axis.set_ylim(len(walks) - 0.4, -0.6)
        axis.grid(axis="y", visible=False)
        axis.set_xlim(0.0, max(walk["seconds"] for walk in walks))
        axis.set_xlabel("time, s")
        axis.figure.legend(loc="outside upper left", ncols=2)

    return markup.chart(paint, "Gait", size=(markup.CHART[0], 0.9 + 0.5 * len(walks)))


def touchdown_body(found: Record) -> Html:
    """Build the section of touchdowns on treads: histograms, medians and deviations."""
    groups = found["groups"]
    ways = dict.fromkeys(group["way"] for group in groups)
    text = (
        f"The sole's centre at each touchdown, from the nosing (0) towards the riser "
        f"({100 * found['tread_m']:.0f} cm); below 0 it hangs over the edge. MAD: median absolute "
        f"deviation from the median; the paper has {PAPER_MAD} cm in descent."
    )
    feet = (*FEET, "both")
    columns = [Column("stairs"), *(Column(f"touchdowns {foot}", True) for foot in feet)]
    columns += [Column(f"{name} {foot}", True) for name in ("median", "MAD") for foot in feet]
    rows = []
    for way, size in dict.fromkeys((group["way"], group["size_m"]) for group in groups):
        of = {g["foot"]: g for g in groups if (g["way"], g["size_m"]) == (way, size)}
        cells = [f"{of[foot]['touchdowns']:,}" for foot in feet]
        cells += [_centimetres(of[foot][key]) for key in ("median_m", "mad_m") for foot in feet]
        rows.append((f"{way}, {generators.format_size('stairs', size)}", *cells))
    charts = markup.wide_charts(*(touchdown_chart(found, way) for way in ways))
    return join(paragraph(text), charts, markup.table(columns, rows))


def touchdown_chart(found: Record, way: str) -> Html:
    """Draw where each foot comes down on treads of this direction, over all sizes."""
    of = [group for group in found["groups"] if group["way"] == way]
    bins = {foot: sum(np.array(g["bins"]) for g in of if g["foot"] == foot) for foot in FEET}
    total, tread = max(1, sum(int(np.sum(n)) for n in bins.values())), 100 * found["tread_m"]

    def paint(axis: Axes) -> None:
        bottom = 0.0
        for foot, colour in FEET.items():
            share = 100.0 * np.asarray(bins[foot]) / total
            edges = 100 * (found["first_m"] + found["bin_m"] * np.arange(len(share) + 1))
            axis.bar(
                edges[:-1], share, 0.9 * np.diff(edges), bottom, align="edge", color=colour,
                label=f"{foot} foot",
            )  # fmt: skip
            axis.set_xlim(edges[0], edges[-1])
            bottom = bottom + share
        top = 1.25 * max(axis.get_ylim()[1], 1.0)
        axis.set_ylim(0.0, top)
        for x, name, side in ((0.0, "nosing", "left"), (tread, "riser", "right")):
            axis.axvline(x, color=EDGE, lw=1.0, ls="--")
            pad = 0.6 if side == "left" else -0.6
            axis.text(x + pad, 0.97 * top, name, ha=side, va="top", color=EDGE, size=8)
        axis.set_xlabel("from the nosing towards the riser, cm")
        axis.set_ylabel("touchdowns, %")
        axis.set_title(f"{way} the stairs, {total:,} touchdowns")
        axis.figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=2)

    return markup.chart(paint, f"Touchdowns {way} the stairs")


def film_body(films: Sequence[Record], folder: Path | None) -> Html:
    """Build the section of failures on film; files are looked for in `folder`, if there is one."""
    return markup.wide_charts(*(element("div", _film(film, folder)) for film in films))


def sections(record: Record, folder: Path | None) -> list[Section]:
    """Build the sections of those parts that the record has."""
    built = []
    if record.get("gait"):
        built.append(Section("Gait", gait_body(record["gait"])))
    if (record.get("touchdowns") or {}).get("groups"):
        built.append(Section("Touchdowns on stairs", touchdown_body(record["touchdowns"])))
    if record.get("films"):
        built.append(Section("Failures on film", film_body(record["films"], folder)))
    return built


def _film(film: Record, folder: Path | None) -> Html:
    where = " ".join(str(film[key]) for key in ("kind", "level") if key in film)
    way = f", {NAMES[film['lane']]}" if film["lane"] in NAMES else ""
    which = f"first of {film['failures']} failures" if film["failures"] > 1 else "only failure"
    text = (
        f"{where}, {_size(film)}{way}: the {which}, "
        f"{evaluation_charts.display_name(film['ending'])} after {film['seconds']:.1f} s."
    )
    if "why" in film:
        return join(paragraph(text), note(f"No film: {film['why']}"))
    if folder is None:
        return paragraph(text)
    return join(paragraph(text), markup.media(folder / film["file"], MOST_FILM))


def _lane_name(walk: Record) -> str:
    name = NAMES.get(walk["lane"], str(walk["lane"]))
    return f"{name} {_size(walk)}" if walk.get("size_m") else name


def _size(of: Record) -> str:
    return generators.format_size(str(of.get("lane") or of.get("kind")), of["size_m"])


def _seconds(value: float | None) -> str:
    return MISSING if value is None else f"{value:.2f} s"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _centimetres(value: float | None) -> str:
    return MISSING if value is None else f"{100.0 * value:.1f} cm"
