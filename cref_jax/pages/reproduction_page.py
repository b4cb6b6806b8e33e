"""The page of a reproduction: variants x seeds beside the paper's Tables II and III.

It is made of the record that `reproduction.results` builds, and may be made at any time: rows that
are not finished are marked as such and have no part in a number.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cref_jax.config import folders
from cref_jax.pages import evaluation_charts, learning_charts, markup
from cref_jax.pages.evaluation_charts import SuccessRate
from cref_jax.pages.learning_charts import LevelCurve
from cref_jax.pages.markup import MISSING, Column, Html, Section, element, join, note, paragraph
from cref_jax.terrain import generators

Record = Mapping[str, Any]

INTERVALS = (
    "Below a number: the 95 % interval over all trials (Wilson), and with two seeds or more that "
    "of the mean over seeds (Student's t; two seeds leave much open). The first says how well "
    "these policies were measured, the second what other seeds of the same training would give."
)


def write(record: Record, out: Path) -> None:
    """Write the page.

    Raises:
        ConfigError: `out` is not .html or cannot be written.
    """
    finished = sum(row["finished"] for row in record["rows"])
    head = f"The paper's tables by {len(record['variants'])} variants on {record['terrain']}"
    lead = markup.tiles(
        [
            (f"{finished} of {len(record['rows'])}", "rows are trained and evaluated"),
            (_millions(record["samples"]), f"samples per run; {_paper_samples(record)}"),
            (f"{record['trials']:,}", f"trials per cell; the paper {record['paper_trials']:,}"),
        ]
    )
    markup.write(out, markup.document(head, lead, list(_sections(record))))


def _sections(record: Record) -> Iterator[Section]:
    measured = [of for of in record["variants"] if of.get("success")]
    if measured:
        yield Section("Success (Table II)", _success_body(record, measured))
        yield Section("Failures on stairs (Table III)", _stairs_body(record, measured))
        yield Section("Where feet land on stairs", _touchdown_body(record, measured))
    gated = [of for of in record["variants"] if of["gate"]]
    if gated:
        yield Section("Highway gate", _gate_body(record, gated))
    if any(row["curves"] for row in record["rows"]):
        yield Section("Levels in training", _level_body(record))
    yield Section("Variants", _variant_body(record["variants"]))
    yield Section("Rows", _row_body(record["rows"]))
    yield Section("How it was measured", _method_body(record))


def _success_body(record: Record, variants: Sequence[Record]) -> Html:
    """Build Table II: a row per variant, and one of the paper below it."""
    first = variants[0]["success"]["cells"]
    columns = [Column("success, %"), Column("mean of all", True)]
    columns += [Column(f"{cell['kind']} {_size(cell)}", True) for cell in first]
    rows = []
    for of in variants:
        every = [of["success"]["overall"], *of["success"]["cells"]]
        rows.append([_title(of), *(_rate_cell(value) for value in every)])
        if of["paper"]:
            theirs = [f"{100.0 * value['paper']:.2f}" for value in every]
            rows.append([f"paper: {of['paper']}", *theirs])
    rates = [
        SuccessRate(
            _title(of),
            whole["seeds"]["mean"],
            whole["wilson_low"],
            whole["wilson_high"],
            whole["paper"],
            tuple(whole["seeds"]["each"]),
        )
        for of in variants
        for whole in [of["success"]["overall"]]
    ]
    chart = markup.wide_charts(evaluation_charts.success_chart(rates))
    return join(_sample_note(record), paragraph(INTERVALS), chart, markup.table(columns, rows))


def _stairs_body(record: Record, variants: Sequence[Record]) -> Html:
    """Build Table III: failures going up and down, as shares, for the numbers of trials differ."""
    columns = [Column("failures, % of the trials of a direction")]
    columns += [
        Column(f"{part['way']} {_size({'kind': 'stairs', **part})}", True)
        for part in variants[0]["stairs"]
    ]
    rows = []
    for of in variants:
        cells = [_rate_cell(p, f"{p['failures']} of {p['trials']}") for p in of["stairs"]]
        rows.append([_title(of), *cells])
        if of["paper"]:
            theirs = [f"{100.0 * part['paper']:.1f}" for part in of["stairs"]]
            rows.append([f"paper: {of['paper']}", *theirs])
    return join(_sample_note(record), markup.table(columns, rows))


def _touchdown_body(record: Record, variants: Sequence[Record]) -> Html:
    size = generators.format_size("stairs", variants[0]["touchdowns"][0]["size_m"])
    text = (
        f"MAD: median absolute deviation of where the soles' centres land on treads of stairs of "
        f"{size}, from the median, both feet. In brackets each seed's and the interval of the mean "
        "over seeds; there is none over trials. The paper gives that of the way down."
    )
    columns = [Column("variant")]
    columns += [Column(f"{n} {way}", True) for way in ("up", "down") for n in ("touchdowns", "MAD")]
    columns.append(Column("paper, down", True))
    rows = [
        [
            _title(of),
            *(
                text
                for part in of["touchdowns"]
                for text in (f"{part['touchdowns']:,}", _few(part["mad_m"], 100.0, 1, " cm"))
            ),
            next(
                (f"{100 * p['paper_m']:.1f} cm" for p in of["touchdowns"] if p["paper_m"]), MISSING
            ),
        ]
        for of in variants
    ]
    return join(_sample_note(record), paragraph(text), markup.table(columns, rows))


def _gate_body(record: Record, variants: Sequence[Record]) -> Html:
    """Build the tables of differences of the gate, beside the paper's order, and of its means."""
    text = (
        "Differences of the mean gate between two states. The paper gives no numbers; it finds "
        "each of these above 0. Means over seeds, in brackets each seed's and the interval."
    )
    names = [f"{d['higher']} - {d['lower']}" for d in variants[0]["gate"]["differences"]]
    gaps = [
        [_title(of), *(_few(d["difference"], 1.0, 3) for d in of["gate"]["differences"])]
        for of in variants
    ]
    gaps.append(["paper: Full CReF", *("above 0" for _ in names)])
    states = variants[0]["gate"]["states"]
    means = [
        [f"{state['group']}: {state['state']}", *(_gate_mean(of, k) for of in variants)]
        for k, state in enumerate(states)
    ]
    heads = [Column("state"), *(Column(_title(of), True) for of in variants)]
    return join(
        _sample_note(record),
        paragraph(text),
        markup.table([Column("variant"), *(Column(name, True) for name in names)], gaps),
        markup.collapsible("The mean gate in each state", markup.table(heads, means)),
    )


def _level_body(record: Record) -> Html:
    """Build the curves of the level on each kind of lane, and the table of the last levels."""
    begun = [row for row in record["rows"] if row["curves"]]
    kinds = list(begun[0]["curves"]["levels"])  # all rows have one terrain
    millions = lambda row: [n / 1e6 for n in row["curves"]["samples"]]
    plots = [
        learning_charts.level_chart(
            f"level, {kind.replace('_', ' ')}",
            [
                LevelCurve(row["variant"], millions(row), row["curves"]["levels"][kind])
                for row in begun
            ],
        )
        for kind in kinds
    ]
    done = [of for of in record["variants"] if of["levels"]]
    rows = [[_title(of), *(_few(of["levels"][kind], 1.0, 1) for kind in kinds)] for of in done]
    columns = [Column("last level"), *(Column(kind.replace("_", " "), True) for kind in kinds)]
    text = (
        "Difficulty of the lanes that the robots have earned, 0 the easiest, while they explore: "
        "each point is the mean over the robots on that kind of lane and a twentieth of the "
        "training. Rows that are still trained are drawn, too; hpl's begin with its teacher's "
        "samples. After few samples every cell of Table II is near 0, and variants differ here."
    )
    table = [markup.table(columns, rows)] if done else []
    return join(_sample_note(record), paragraph(text), markup.charts(*plots), *table)


def _variant_body(variants: Sequence[Record]) -> Html:
    columns = [Column("variant"), Column("parameters of the policy", True), Column("of full", True)]
    columns += [Column("of the critic", True), Column("row of the paper"), Column("")]
    rows = [
        (
            of["variant"],
            f"{of['parameters']:,}",
            f"{100.0 * share:.1f} %" if (share := of["parameters_of_full"]) else MISSING,
            f"{of['critic_parameters']:,}",
            of["paper"] or MISSING,
            "differs from full by more than 10 %" if of["other_size"] else "",
        )
        for of in variants
    ]
    text = (
        "All have the same reward, but for the two ablations of the reward (foot_contact_quality, "
        "no_foothold_reward), and the same optimiser, terrain, seeds and samples. Those of hpl "
        "include its teacher's, whose parameters are not counted. Where the others learn to read "
        "out the ground (ppo.readout_weight, on a CPU), its teacher, who is given it, does not."
    )
    return join(paragraph(text), markup.table(columns, rows))


def _row_body(rows: Sequence[Record]) -> Html:
    columns = [Column("row"), Column("state")]
    columns += [Column(n, True) for n in ("samples", "samples/s", "training", "evaluation")]
    hours = lambda seconds: f"{seconds / 3600:.2f} h" if seconds else MISSING
    table = [
        (
            row["row"],
            _state(row),
            f"{_millions(row['samples'])} of {_millions(row['planned'])}",
            f"{row['samples_per_s']:,.0f}" if row["samples_per_s"] else MISSING,
            hours(row["training_s"]),
            hours(row["evaluation_s"]),
        )
        for row in rows
    ]
    return markup.table(columns, table)


def _method_body(record: Record) -> Html:
    values = [
        ("terrain", record["terrain"]),
        ("preset", record["device"]),
        ("seeds", ", ".join(map(str, record["seeds"]))),
        ("settings for all rows", " ".join(record["settings"]) or "those of the preset"),
    ]
    return join(
        paragraph(record["rule"]),
        paragraph(record["gate_rule"]),
        note(
            "The paper's twenty scenes in MuJoCo are not part of it: ",
            markup.code(folders.command_line("eval", "--suite", "ood", "--run", "ROW")),
            ".",
        ),
        markup.definition_list(values),
    )


def _sample_note(record: Record) -> Html:
    """Say beside the numbers that they are not of the paper's training."""
    return note(
        f"Trained for {_millions(record['samples'])} samples per run, "
        f"{100.0 * record['samples'] / record['paper_samples']:.2g} % of the paper's; "
        f"{_paper_samples(record)}. Another simulator, other lanes and another model of the robot."
    )


def _state(row: Record) -> str:
    if row["finished"]:
        return "finished"
    if row["samples"] == row["planned"]:
        return "unfinished: to be evaluated"
    return "unfinished: being trained" if row["training_s"] else "unfinished: not begun"


def _title(of: Record) -> str:
    """Name a variant with the number of its runs."""
    runs = "single run" if len(of["seeds"]) == 1 else f"{len(of['seeds'])} seeds"
    return f"{of['variant']}, {runs}{' so far' if len(of['seeds']) < of['planned'] else ''}"


def _rate_cell(of: Record, count: str = "") -> Html:
    """Build a cell of a rate in percent: the mean over seeds, then both intervals."""
    few = of["seeds"]
    if few["mean"] is None:
        return Html(MISSING)
    lines = [count] if count else []
    lines.append(f"trials {_span(of['wilson_low'], of['wilson_high'])}")
    if few["low"] is not None:
        lines.append(f"seeds {_span(few['low'], few['high'])}")
    small = [element("div", line, class_="faint") for line in lines]
    return join(element("strong", f"{100.0 * few['mean']:.1f}"), *small)


def _few(few: Record, scale: float, digits: int, unit: str = "") -> str:
    """Format a mean over seeds with each seed's value and its interval."""
    if few["mean"] is None:
        return MISSING
    number = lambda x: f"{scale * x:.{digits}f}"
    text = f"{number(few['mean'])}{unit}"
    if few["low"] is None:
        return text
    each = ", ".join(map(number, few["each"]))
    return f"{text} ({each}; {number(few['low'])} to {number(few['high'])})"


def _gate_mean(of: Record, number: int) -> str:
    state = of["gate"]["states"][number]
    return f"{_few(state['mean'], 1.0, 3)}, {state['steps']:,} steps"


def _span(low: float, high: float) -> str:
    return f"{100.0 * low:.1f}-{100.0 * high:.1f}"


def _size(cell: Record) -> str:
    size = generators.format_size(str(cell["kind"]), cell["size_m"])
    return f"{size} (OOD)" if cell["level"] == "ood" else size


def _millions(samples: int) -> str:
    return f"{samples / 1e6:,.1f} M" if samples >= 1e5 else f"{samples:,}"


def _paper_samples(record: Record) -> str:
    return f"the paper has 2 billion ({_millions(record['paper_samples'])})"
