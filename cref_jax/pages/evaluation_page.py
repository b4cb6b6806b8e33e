"""The page of an evaluation: `eval.json` for human readers.

Rates in a record are fractions. A section without data is omitted and unknown keys are ignored, so
that records of other versions can be read.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cref_jax.errors import ConfigError
from cref_jax.pages import evaluation_charts, evaluation_tables, markup, walk_pictures
from cref_jax.pages.evaluation_charts import FailureCounts, SpeedCurve, SuccessRate, display_name
from cref_jax.pages.markup import MISSING, Column, Html, Section, element, join, paragraph
from cref_jax.terrain import generators

Record = Mapping[str, Any]
Number = int | float  # JSON writes a rate as either

TITLES = {
    "table": "Success on stairs, gaps and platforms",
    "ood": "Success on scenes outside the training set",
    "walk": "Walking on flat ground",
    "cross": "Crossing obstacles",
    "robust": "Success under full randomisation",
    "commands": "Following commands on flat ground",
    "gate": "The highway gate by terrain, contact phase and posture",
}
PLAIN = {  # record key of the suites walk and cross: (label, unit)
    "kind": ("kind of obstacle", ""),
    "size_m": ("obstacle size", ""),
    "episodes": ("episodes", ""),
    "fell": ("episodes with a fall", ""),
    "fell_by_policy": ("of them, by policy", ""),
    "trials": ("trials", ""),
    "successes": ("trials that reached the end of the lane", ""),
    "speed_error": ("mean forward speed error", " m/s"),
    "tracking_error": ("planar velocity error per step", " m/s"),
    "airborne": ("share of time in the air, left and right foot", ""),
    "step_seconds": ("time between touchdowns of a foot", " s"),
    "speed": ("mean forward speed", " m/s"),
}
HEAD_KEYS = ("device", "cores", "seed", "iteration", "time", "run", "source")


def write(record: Record, out: Path) -> None:
    """Write the page of an evaluation.

    Raises:
        ConfigError: `out` is not .html or cannot be written, or the record has an unknown form.
    """
    body = sections(record, out.parent)
    markup.write(out, markup.document(title(record), lead(record), body))


def title(record: Record) -> str:
    """Return the title of the evaluation's suite."""
    suite = str(record.get("suite", "unknown"))
    heading = TITLES.get(suite, f"Evaluation {suite}")
    return f"{heading}: {_cell_name(record)}" if suite == "cross" else heading


def lead(record: Record) -> Html:
    """Build the tiles with the headline figures.

    Raises:
        ConfigError: the record has an unknown form.
    """
    return _refuse_unknown_form(lambda: markup.tiles(_make_tiles(record)))


def sections(record: Record, folder: Path | None = None) -> list[Section]:
    """Build the sections below the headline figures; films are files of `folder`.

    Raises:
        ConfigError: the record has an unknown form.
    """
    return _refuse_unknown_form(lambda: list(_make_sections(record, folder)))


def _refuse_unknown_form(make: Any) -> Any:
    """Call `make`; turn the errors of a malformed record into one ConfigError."""
    try:
        return make()
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"this evaluation has an unknown form: {error!r}") from None


def _make_sections(record: Record, folder: Path | None) -> Iterator[Section]:
    cells = record.get("cells") or []
    if cells:
        yield Section("Success by kind and level", _success_body(record, cells))
        yield Section("Failures", _failure_body(cells))
        if any(cell.get("by_speed") for cell in cells):
            yield Section("Success by commanded speed", _speed_body(cells))
    if record.get("scenes"):
        yield Section("Scenes", _scene_body(record["scenes"]))
    places = [of for of in (*cells, *(record.get("scenes") or [])) if of.get("sideways")]
    if places or record.get("sideways"):
        rows = [(_place_name(of), of["sideways"]) for of in places or [record]]
        yield Section("Lateral drift", evaluation_tables.drift_table(rows))
    if record.get("parts"):
        rates = [(row["part"], _cell_name(row), row["rate"]) for row in record["parts"]]
        yield Section("One randomised part at a time", evaluation_tables.part_table(rates))
    if record.get("commands"):
        yield Section("Commands", evaluation_tables.command_table(record["commands"]))
    if record.get("gate"):
        yield Section("Highway gate", evaluation_tables.gate_table(record["gate"]))
    if record.get("conditions"):
        yield Section("Conditions", _condition_table(record["conditions"]))
    plain = _plain_body(record)
    if plain and not cells:
        yield Section("Result", plain)
    yield from walk_pictures.sections(record, folder)
    yield Section("How it was measured", _method_body(record))


def _make_tiles(record: Record) -> Iterator[tuple[str, str]]:
    """Yield the headline figures and their labels."""
    overall, scenes = record.get("overall") or {}, record.get("scenes") or []
    if overall.get("rate") is not None:
        label = "of the trials succeed, over all cells"
        if overall.get("wilson_low") is not None:
            label += f" (95 % interval {_interval(overall)})"
        yield _percent(overall["rate"]), label + _paper_note(overall["rate"], overall.get("paper"))
        for key, where in (("trained", "at the trained levels"), ("ood", "beyond training")):
            rate = overall.get(key)
            if rate is not None:
                yield _percent(rate), where + _paper_note(rate, overall.get(f"paper_{key}"))
    if record.get("passed") is not None:
        yield f"{record['passed']} of {len(scenes)}", "scenes passed"
    if record.get("suite") == "walk":
        stood = record["episodes"] - record["fell"]
        note = f" (95 % interval {_interval(record)})" if "wilson_low" in record else ""
        yield f"{stood} of {record['episodes']}", "episodes without a fall" + note
    if record.get("suite") == "commands":
        stand, stop = record["commands"][0], record["stop"]
        yield f"{stand['stood']} of {stand['trials']}", "commanded to stand, move less than 5 cm"
        yield f"{stand['still']} of {stand['trials']}", "commanded to stand, take no step after 2 s"
        if stop["distance_m"] is not None:
            yield f"{100.0 * stop['distance_m']:.0f} cm", "stopping distance from 0.6 m/s"
    if record.get("suite") == "cross":
        rate = _percent(record["successes"] / record["trials"])
        yield rate, f"of {record['trials']} trials reach the end of the lane"


def _success_body(record: Record, cells: Sequence[Record]) -> Html:
    """Build the cells' rates beside the paper's, as charts and as a table."""
    rates = [
        SuccessRate(
            _cell_name(cell),
            cell["rate"],
            cell["wilson_low"],
            cell["wilson_high"],
            (cell.get("paper") or {}).get("rate"),
            tuple(cell.get("by_policy") or ()),
        )
        for cell in cells
    ]
    failures = [_failure_counts(_cell_name(cell), cell) for cell in cells]
    plots = markup.wide_charts(
        evaluation_charts.success_chart(rates), evaluation_charts.failure_chart(failures)
    )
    several = any(len(rate.by_policy) > 1 for rate in rates)
    numbers = ("size", "successes", "success", "95 % interval", "paper")
    columns = [Column("kind"), Column("level"), *(Column(n, True) for n in numbers)]
    columns.append(Column("compared with the paper"))
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
            _paper_percent(paper.get("rate")),
            _format_difference(paper),
        ]
        rows.append(
            [*row, *([_policy_rates(cell), _points(cell.get("spread"))] if several else [])]
        )
    if several:
        columns += [Column("each policy, %", True), Column("spread, points", True)]
    return join(_interval_note(cells), plots, markup.table(columns, rows))


def _interval_note(cells: Sequence[Record]) -> Html:
    """Explain the width and the meaning of the confidence intervals."""
    half = sorted(50.0 * (cell["wilson_high"] - cell["wilson_low"]) for cell in cells)
    trials = sorted({cell["trials"] for cell in cells})
    count = f"{trials[0]}" if len(trials) == 1 else f"{trials[0]} to {trials[-1]}"
    theirs = sorted({p["trials"] for c in cells if (p := c.get("paper") or {}).get("trials")})
    return paragraph(
        f"With {count} trials per cell, the 95 % intervals (Wilson) extend {half[0]:.1f} to "
        f"{half[-1]:.1f} points to either side. They cover the randomness of the trials, not the "
        "variation between training seeds. "
        + (f"The paper has {theirs[-1]} trials per cell. " if theirs else "")
        + "A difference within chance is not significant."
    )


def _failure_body(cells: Sequence[Record]) -> Html:
    """Build the tables of failures by cause and, on stairs, by direction."""
    failures = [_failure_counts(_cell_name(cell), cell) for cell in cells]
    parts = [_cause_table(failures)]
    stairs = [cell for cell in cells if cell.get("up_failures") is not None]
    if stairs:
        columns = [Column("cell"), Column("up", True), Column("down", True), Column("trials", True)]
        keys = ("up_failures", "down_failures", "trials")
        rows = [[_cell_name(c), *(_count(c.get(key)) for key in keys)] for c in stairs]
        parts.append(markup.table(columns, rows, "Failures on the way up and down"))
    return join(*parts)


def _cause_table(failures: Sequence[FailureCounts]) -> Html:
    names = list(dict.fromkeys(cause for f in failures for cause in f.by_cause))
    columns = [Column(""), Column("trials", True), *(Column(display_name(n), True) for n in names)]
    rows = [[f.name, str(f.trials), *(_count(f.by_cause.get(n)) for n in names)] for f in failures]
    return markup.table(columns, rows, "Failures by cause")


def _speed_body(cells: Sequence[Record]) -> Html:
    """Build success over commanded speed: a chart per kind and a table."""
    plots, rows = [], []
    for kind in dict.fromkeys(cell["kind"] for cell in cells):
        lines = []
        for cell in (cell for cell in cells if cell["kind"] == kind and cell.get("by_speed")):
            bins = cell["by_speed"]
            rates = [b["successes"] / b["trials"] if b["trials"] else math.nan for b in bins]
            middles = [0.5 * (b["low"] + b["high"]) for b in bins]
            lines.append(SpeedCurve(str(cell["level"]), tuple(middles), tuple(rates)))
            for b, rate in zip(bins, rates, strict=True):
                speed = f"{b['low']:.1f} to {b['high']:.1f} m/s"
                counts = (str(b["trials"]), str(b["successes"]))
                rows.append((_cell_name(cell), speed, *counts, _percent(rate)))
        plots.append(evaluation_charts.speed_chart(str(kind), lines))
    numbers = [Column(title, True) for title in ("speed", "trials", "successes", "success")]
    table = markup.table([Column("cell"), *numbers], rows)
    return join(markup.charts(*plots), markup.collapsible("Success by speed as a table", table))


def _scene_body(scenes: Sequence[Record]) -> Html:
    rates = [
        SuccessRate(_scene_name(s), s["rate"], s["wilson_low"], s["wilson_high"]) for s in scenes
    ]
    failures = [_failure_counts(_scene_name(scene), scene) for scene in scenes]
    numbers = ("trials", "successes", "success", "95 % interval")
    columns = [Column("scene"), *(Column(n, True) for n in numbers)]
    rows = [
        (_scene_name(s), str(s["trials"]), str(s["successes"]), _percent(s["rate"]), _interval(s))
        for s in scenes
    ]
    plots = markup.wide_charts(
        evaluation_charts.success_chart(rates), evaluation_charts.failure_chart(failures)
    )
    return join(plots, markup.table(columns, rows), _cause_table(failures))


def _condition_table(conditions: Sequence[Record]) -> Html:
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


def _plain_body(record: Record) -> Html:
    """Build the list of values and failure causes of a record without cells."""
    shown = {**record, "size_m": _size(record)}
    known = [k for k in PLAIN if record.get(k) is not None]
    values = [(PLAIN[k][0], f"{_value(shown[k])}{PLAIN[k][1]}") for k in known]
    if record.get("suite") == "cross" and record.get("successes") and "seconds" in record:
        values.append(("mean time per success", f"{_value(record['seconds'])} s"))
    causes = record.get("by_cause") or {}
    values += [(f"failures: {display_name(cause)}", str(count)) for cause, count in causes.items()]
    return markup.definition_list(values) if values else Html()


def _method_body(record: Record) -> Html:
    """Build the description of the rule, the machine and the policies."""
    parts = [paragraph(str(record["rule"]))] if record.get("rule") else []
    values = [(key, str(record[key])) for key in HEAD_KEYS if record.get(key) is not None]
    if "seconds" in record and record.get("suite") != "cross":
        values.append(("duration", f"{record['seconds']:.1f} s"))
    versions = record.get("versions") or {}
    if versions:
        values.append(("versions", ", ".join(f"{name} {v}" for name, v in versions.items())))
    parts.append(markup.definition_list(values))
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


def _failure_counts(name: str, of: Record) -> FailureCounts:
    return FailureCounts(name, of["trials"], dict(of.get("failures") or {}))


def _cell_name(cell: Record) -> str:
    """Return the kind, level and size of a cell, as far as known."""
    name = " ".join(str(cell[key]) for key in ("kind", "level") if key in cell)
    return f"{name}, {_size(cell)}" if cell.get("size_m") else name


def _place_name(of: Record) -> str:
    return _scene_name(of) if "title" in of else _cell_name(of) or "flat ground"


def _scene_name(scene: Record) -> str:
    return str(scene.get("title") or scene["name"])


def _size(cell: Record) -> str:
    size = cell.get("size_m")
    return MISSING if size is None else generators.format_size(str(cell.get("kind")), size)


def _paper_note(rate: Number, theirs: Number | None) -> str:
    """Format the difference from the paper's rate; empty if the paper has none."""
    if theirs is None:
        return ""
    difference = _format_difference({"difference": rate - theirs})
    return f"; {difference} than the paper's {_paper_percent(theirs)}"


def _format_difference(paper: Record) -> str:
    """Format the difference from the paper's rate in words."""
    difference = paper.get("difference")
    if difference is None:
        return MISSING
    points = abs(100.0 * difference)
    text = f"{points:.1f} points {'lower' if difference < 0.0 else 'higher'}"
    significant = paper.get("significant")
    if significant is None:
        return text
    return text + (", beyond chance" if significant else ", within chance")


def _policy_rates(cell: Record) -> str:
    return ", ".join(f"{100.0 * rate:.1f}" for rate in cell.get("by_policy") or ()) or MISSING


def _points(rate: Number | None) -> str:
    return MISSING if rate is None else f"{100.0 * rate:.1f}"


def _percent(rate: Number | None) -> str:
    return MISSING if rate is None or math.isnan(rate) else f"{100.0 * rate:.1f} %"


def _paper_percent(rate: Number | None) -> str:
    """Format a rate of the paper with its two decimals."""
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
