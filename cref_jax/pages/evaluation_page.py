"""The page of an evaluation: what `eval.json` holds, for people.

Rates in a record are fractions. What a record lacks leaves its section out, and what this version
does not know is passed over, so that records of other versions can be read.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cref_jax.errors import ConfigError
from cref_jax.pages import evaluation_charts, evaluation_tables, markup
from cref_jax.pages.evaluation_charts import Failures, Line, Share, display_name
from cref_jax.pages.markup import MISSING, Column, Html, Section, element, join, paragraph
from cref_jax.terrain import generators

Record = Mapping[str, Any]
Number = int | float  # JSON has both for one thing

TITLES = {
    "table": "Success on stairs, gaps and platforms",
    "ood": "Success on scenes that were never trained on",
    "walk": "Walking on flat ground",
    "cross": "Crossing obstacles",
    "robust": "Success with everything randomised",
    "commands": "Doing what it is told, on flat ground",
}
PLAIN = {  # of the suites walk and cross: name in the record: words, and unit
    "kind": ("kind of obstacle", ""),
    "size_m": ("size of the obstacles", " m"),
    "episodes": ("episodes", ""),
    "fell": ("episodes with a fall", ""),
    "trials": ("trials", ""),
    "successes": ("trials that came to the lane's end", ""),
    "speed_error": ("error of the mean forward speed", " m/s"),
    "tracking_error": ("error of the planar velocity at each step", " m/s"),
    "airborne": ("share of time in the air, left and right foot", ""),
    "step_seconds": ("time between two touchdowns of a foot", " s"),
    "speed": ("mean forward speed", " m/s"),
}
HEAD_KEYS = ("device", "cores", "seed", "iteration", "time", "run", "source")


def write(record: Record, out: Path) -> None:
    """Write the page of an evaluation.

    Raises:
        ConfigError: `out` is no .html or cannot be written, or the record is of no known form.
    """
    markup.write(out, markup.document(title(record), lead(record), sections(record)))


def title(record: Record) -> str:
    """Return what was measured, in a few words."""
    suite = str(record.get("suite", "unknown"))
    words = TITLES.get(suite, f"Evaluation {suite}")
    return f"{words}: {_name(record)}" if suite == "cross" else words


def lead(record: Record) -> Html:
    """Return the figures that people ask for first.

    Raises:
        ConfigError: the record is of no known form.
    """
    with_form = lambda: markup.tiles(_tiles(record))
    return _of_known_form(with_form)


def sections(record: Record) -> list[Section]:
    """Return everything else that a record holds.

    Raises:
        ConfigError: the record is of no known form.
    """
    return _of_known_form(lambda: list(_sections(record)))


def _of_known_form(make: Any) -> Any:
    """Return what `make` makes of a record, or say in one line that it is not one."""
    try:
        return make()
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"this evaluation has no form that is known: {error!r}") from None


def _sections(record: Record) -> Iterator[Section]:
    cells = record.get("cells") or []
    if cells:
        yield Section("Success by kind and level", _success(record, cells))
        yield Section("Failures", _failures(cells))
        if any(cell.get("by_speed") for cell in cells):
            yield Section("Success by commanded speed", _speeds(cells))
    if record.get("scenes"):
        yield Section("Scenes", _scenes(record["scenes"]))
    places = [of for of in (*cells, *(record.get("scenes") or [])) if of.get("sideways")]
    if places or record.get("sideways"):
        rows = [(_place(of), of["sideways"]) for of in places or [record]]
        yield Section("Across the way", evaluation_tables.sideways(rows))
    if record.get("parts"):
        rates = [(row["part"], _name(row), row["rate"]) for row in record["parts"]]
        yield Section("Each part alone", evaluation_tables.parts(rates))
    if record.get("commands"):
        yield Section("Commands", evaluation_tables.commands(record["commands"]))
    if record.get("conditions"):
        yield Section("Conditions", _conditions(record["conditions"]))
    plain = _plain(record)
    if plain and not cells:
        yield Section("Result", plain)
    yield Section("How it was measured", _measured(record))


def _tiles(record: Record) -> Iterator[tuple[str, str]]:
    """Return the few figures at the top."""
    overall, scenes = record.get("overall") or {}, record.get("scenes") or []
    if overall.get("rate") is not None:
        what = "of the trials succeed, over all cells"
        if overall.get("wilson_low") is not None:
            what += f" (95 % interval {_interval(overall)})"
        yield _percent(overall["rate"]), what + _paper(overall["rate"], overall.get("paper"))
        for key, where in (("trained", "at the trained levels"), ("ood", "beyond the training")):
            rate = overall.get(key)
            if rate is not None:
                yield _percent(rate), where + _paper(rate, overall.get(f"paper_{key}"))
    if record.get("passed") is not None:
        yield f"{record['passed']} of {len(scenes)}", "scenes passed"
    if record.get("suite") == "walk":
        stood = record["episodes"] - record["fell"]
        yield f"{stood} of {record['episodes']}", "episodes without a fall"
    if record.get("suite") == "commands":
        stand, stop = record["commands"][0], record["stop"]
        yield f"{stand['stood']} of {stand['trials']}", "told to stand, move less than 5 cm"
        yield f"{stand['still']} of {stand['trials']}", "told to stand, take no step after 2 s"
        if stop["distance_m"] is not None:
            yield f"{100.0 * stop['distance_m']:.0f} cm", "further at 0.6 m/s when told to stop"
    if record.get("suite") == "cross":
        rate = _percent(record["successes"] / record["trials"])
        yield rate, f"of {record['trials']} trials come to the lane's end"


def _success(record: Record, cells: Sequence[Record]) -> Html:
    """Return the cells' rates beside the paper's, in a chart and as a table."""
    shares = [
        Share(
            _name(cell),
            cell["rate"],
            cell["wilson_low"],
            cell["wilson_high"],
            (cell.get("paper") or {}).get("rate"),
            tuple(cell.get("by_policy") or ()),
        )
        for cell in cells
    ]
    failures = [_causes(_name(cell), cell) for cell in cells]
    drawn = markup.wide(
        evaluation_charts.success_chart(shares), evaluation_charts.failure_chart(failures)
    )
    several = any(len(share.by_policy) > 1 for share in shares)
    numbers = ("size", "successes", "success", "95 % interval", "paper")
    columns = [Column("kind"), Column("level"), *(Column(n, True) for n in numbers)]
    columns.append(Column("against the paper"))
    rows = []
    for cell in cells:
        paper = cell.get("paper") or {}
        row = [
            str(cell["kind"]),
            str(cell["level"]),
            _size(cell),
            f"{cell['successes']} of {cell['trials']}",
            element("strong", _percent(cell["rate"])),
            _interval(cell),
            _exact(paper.get("rate")),
            _against(paper),
        ]
        rows.append([*row, *([_each(cell), _points(cell.get("spread"))] if several else [])])
    if several:
        columns += [Column("each policy, %", True), Column("spread, points", True)]
    return join(_widths(cells), drawn, markup.table(columns, rows))


def _widths(cells: Sequence[Record]) -> Html:
    """Return how much the intervals leave open."""
    half = sorted(50.0 * (cell["wilson_high"] - cell["wilson_low"]) for cell in cells)
    trials = sorted({cell["trials"] for cell in cells})
    many = f"{trials[0]}" if len(trials) == 1 else f"{trials[0]} to {trials[-1]}"
    theirs = sorted({p["trials"] for c in cells if (p := c.get("paper") or {}).get("trials")})
    return paragraph(
        f"With {many} trials a cell, the 95 % intervals (Wilson) reach {half[0]:.1f} to "
        f"{half[-1]:.1f} points to either side. They cover the chance in the trials alone, not "
        "what training anew with another seed would change. "
        + (f"The paper counts {theirs[-1]} trials a cell. " if theirs else "")
        + "A difference that is within chance says nothing."
    )


def _failures(cells: Sequence[Record]) -> Html:
    """Return why trials failed, and on stairs whether it was up or down."""
    failures = [_causes(_name(cell), cell) for cell in cells]
    parts = [_cause_table(failures)]
    ways = [cell for cell in cells if cell.get("up_failures") is not None]
    if ways:
        columns = [Column("cell"), Column("up", True), Column("down", True), Column("trials", True)]
        keys = ("up_failures", "down_failures", "trials")
        rows = [[_name(c), *(_count(c.get(key)) for key in keys)] for c in ways]
        parts.append(markup.table(columns, rows, "Failures on the way up and down"))
    return join(*parts)


def _cause_table(failures: Sequence[Failures]) -> Html:
    names = list(dict.fromkeys(cause for f in failures for cause in f.by_cause))
    columns = [Column(""), Column("trials", True), *(Column(display_name(n), True) for n in names)]
    rows = [[f.name, str(f.trials), *(_count(f.by_cause.get(n)) for n in names)] for f in failures]
    return markup.table(columns, rows, "Failures by cause")


def _speeds(cells: Sequence[Record]) -> Html:
    """Return success over the commanded speed, a chart a kind."""
    drawn, rows = [], []
    for kind in dict.fromkeys(cell["kind"] for cell in cells):
        lines = []
        for cell in (cell for cell in cells if cell["kind"] == kind and cell.get("by_speed")):
            bins = cell["by_speed"]
            rates = [b["successes"] / b["trials"] if b["trials"] else math.nan for b in bins]
            middles = [0.5 * (b["low"] + b["high"]) for b in bins]
            lines.append(Line(str(cell["level"]), tuple(middles), tuple(rates)))
            for b, rate in zip(bins, rates, strict=True):
                speed = f"{b['low']:.1f} to {b['high']:.1f} m/s"
                many = (str(b["trials"]), str(b["successes"]))
                rows.append((_name(cell), speed, *many, _percent(rate)))
        drawn.append(evaluation_charts.speed_chart(str(kind), lines))
    numbers = [Column(title, True) for title in ("speed", "trials", "successes", "success")]
    table = markup.table([Column("cell"), *numbers], rows)
    return join(markup.charts(*drawn), markup.folded("Success by speed as a table", table))


def _scenes(scenes: Sequence[Record]) -> Html:
    shares = [Share(str(_called(s)), s["rate"], s["wilson_low"], s["wilson_high"]) for s in scenes]
    failures = [_causes(_called(scene), scene) for scene in scenes]
    numbers = ("trials", "successes", "success", "95 % interval")
    columns = [Column("scene"), *(Column(n, True) for n in numbers)]
    rows = [
        (_called(s), str(s["trials"]), str(s["successes"]), _percent(s["rate"]), _interval(s))
        for s in scenes
    ]
    drawn = markup.wide(
        evaluation_charts.success_chart(shares), evaluation_charts.failure_chart(failures)
    )
    return join(drawn, markup.table(columns, rows), _cause_table(failures))


def _conditions(conditions: Sequence[Record]) -> Html:
    columns = [Column("condition"), Column("value"), Column("trials", True)]
    columns += [Column(n, True) for n in ("successes", "success", "scenes passed")]
    rows = [
        (
            str(c["name"]),
            str(c.get("value", "")),
            str(c["trials"]),
            str(c["successes"]),
            _percent(c["successes"] / c["trials"] if c["trials"] else math.nan),
            _count(c.get("passed")),
        )
        for c in conditions
    ]
    return markup.table(columns, rows)


def _plain(record: Record) -> Html:
    """Return the values of a record without cells, and why its trials failed."""
    values = [(words, f"{_value(record[k])}{u}") for k, (words, u) in PLAIN.items() if k in record]
    if record.get("suite") == "cross" and "seconds" in record:
        values.append(("mean time of a success", f"{_value(record['seconds'])} s"))
    causes = record.get("by_cause") or {}
    values += [(f"failures: {display_name(cause)}", str(count)) for cause, count in causes.items()]
    return markup.pairs(values) if values else Html()


def _measured(record: Record) -> Html:
    """Return the rule, the machine and the policies."""
    parts = [paragraph(str(record["rule"]))] if record.get("rule") else []
    values = [(key, str(record[key])) for key in HEAD_KEYS if record.get(key) is not None]
    if "seconds" in record and record.get("suite") != "cross":
        values.append(("time that it took", f"{record['seconds']:.1f} s"))
    versions = record.get("versions") or {}
    if versions:
        values.append(("versions", ", ".join(f"{name} {v}" for name, v in versions.items())))
    parts.append(markup.pairs(values))
    policies = record.get("policies") or []
    if policies:
        columns = [Column("policy"), Column("from"), Column("iteration", True)]
        columns += [Column("samples", True), Column("digest (SHA-256)")]
        rows = [
            (
                str(p.get("name", MISSING)),
                markup.code(str(p.get("source", MISSING))),
                _count(p.get("iteration")),
                _count(p.get("samples")),
                markup.code(str(p.get("digest") or MISSING)),
            )
            for p in policies
        ]
        parts.append(markup.table(columns, rows))
    return join(*parts)


def _causes(name: str, of: Record) -> Failures:
    return Failures(name, of["trials"], dict(of.get("failures") or {}))


def _name(cell: Record) -> str:
    """Return the kind, level and size of a cell, as far as they are known."""
    words = " ".join(str(cell[key]) for key in ("kind", "level") if key in cell)
    return f"{words}, {_size(cell)}" if cell.get("size_m") else words


def _place(of: Record) -> str:
    return _called(of) if "title" in of else _name(of) or "flat ground"


def _called(scene: Record) -> str:
    return str(scene.get("title") or scene["name"])


def _size(cell: Record) -> str:
    size = cell.get("size_m")
    return MISSING if size is None else generators.extent(str(cell.get("kind")), size)


def _paper(rate: Number, theirs: Number | None) -> str:
    """Return what the paper has, and how far that is from here."""
    if theirs is None:
        return ""
    return f"; {_against({'difference': rate - theirs})} than the paper's {_exact(theirs)}"


def _against(paper: Record) -> str:
    """Return a difference to the paper in words."""
    difference = paper.get("difference")
    if difference is None:
        return MISSING
    points = abs(100.0 * difference)
    way = "lower" if difference < 0.0 else "higher"
    words = f"{points:.1f} points {way}"
    significant = paper.get("significant")
    if significant is None:
        return words
    return words + (", beyond chance" if significant else ", within chance")


def _each(cell: Record) -> str:
    return ", ".join(f"{100.0 * rate:.1f}" for rate in cell.get("by_policy") or ()) or MISSING


def _points(rate: Number | None) -> str:
    return MISSING if rate is None else f"{100.0 * rate:.1f}"


def _percent(rate: Number | None) -> str:
    return MISSING if rate is None or math.isnan(rate) else f"{100.0 * rate:.1f} %"


def _exact(rate: Number | None) -> str:
    """Return a rate of the paper with its two digits."""
    return MISSING if rate is None else f"{100.0 * rate:.2f} %"


def _interval(of: Record) -> str:
    return f"{100.0 * of['wilson_low']:.1f} to {100.0 * of['wilson_high']:.1f} %"


def _count(number: Number | None) -> str:
    return MISSING if number is None else f"{number:,}"


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, list | tuple):
        return ", ".join(_value(part) for part in value)
    return str(value)
