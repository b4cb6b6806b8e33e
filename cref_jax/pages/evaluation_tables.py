"""Tables of the evaluation page that several suites share."""

from collections.abc import Mapping, Sequence
from typing import Any

from cref_jax.pages import markup
from cref_jax.pages.markup import MISSING, Column, Html, join, paragraph

Row = Mapping[str, Any]


def drift_table(rows: Sequence[tuple[str, Row]]) -> Html:
    """Build the table of lateral drift and largest lateral offset, cm, per place."""
    columns = [Column("where")]
    columns += [Column(n, True) for n in ("drift", "largest |y|, mean", "largest |y|, worst")]
    keys = ("drift_m", "largest_m", "worst_m")
    table = [(place, *(f"{100.0 * of[key]:.0f} cm" for key in keys)) for place, of in rows]
    note = "Drift is |y| at the end of a trial; robots steer towards the centre line, y = 0."
    return join(paragraph(note), markup.table(columns, table))


def part_table(rates: Sequence[tuple[str, str, float]]) -> Html:
    """Build the table of success with one randomised part at a time: parts by places."""
    names = list(dict.fromkeys(name for name, _, _ in rates))
    places = list(dict.fromkeys(place for _, place, _ in rates))
    of = {(name, place): f"{100.0 * rate:.1f} %" for name, place, rate in rates}
    columns = [Column("randomised"), *(Column(place, True) for place in places)]
    return markup.table(columns, [(n, *(of.get((n, p), MISSING) for p in places)) for n in names])


def command_table(rows: Sequence[Row]) -> Html:
    """Build the table of tracked velocity, error, falls and air time per command."""
    columns = [Column("command: forward, left m/s, turn rad/s")]
    columns += [
        Column(n, True) for n in ("velocity", "error", "fell", "foot in the air, left and right")
    ]
    numbers = lambda values: MISSING if values is None else ", ".join(f"{x:.2f}" for x in values)
    shares = lambda of: MISSING if of is None else ", ".join(f"{100.0 * x:.1f} %" for x in of)
    table = [
        (
            numbers(row["command"]),
            numbers(row["velocity"]),
            numbers(row["error"]),
            f"{row['fell']} of {row['trials']}",
            shares(row["airborne"]),
        )
        for row in rows
    ]
    return markup.table(columns, table)


def gate_table(rows: Sequence[Row]) -> Html:
    """Build the table of the highway gate per state of each group."""
    columns = [Column("group"), Column("state")]
    columns += [Column(n, True) for n in ("steps", "robots", "mean", "median", "quartiles")]
    number = lambda x: MISSING if x is None else f"{x:.3f}"
    table = [
        (
            str(row["group"]),
            str(row["state"]),
            f"{row['n']:,}",
            str(row["robots"]),
            number(row["mean"]),
            number(row["median"]),
            MISSING if row["q25"] is None else f"{row['q25']:.3f} to {row['q75']:.3f}",
        )
        for row in rows
    ]
    return markup.table(columns, table)
