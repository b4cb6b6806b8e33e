"""Tables of an evaluation's page that are the same whatever was judged."""

from collections.abc import Mapping, Sequence
from typing import Any

from cref_jax.pages import markup
from cref_jax.pages.markup import MISSING, Column, Html, join, paragraph

Row = Mapping[str, Any]


def sideways(rows: Sequence[tuple[str, Row]]) -> Html:
    """Return how far robots drift, and how near to the way's side they come, cm, by place."""
    columns = [Column("where")]
    columns += [Column(n, True) for n in ("drift", "largest |y|, mean", "largest |y| of all")]
    keys = ("drift_m", "largest_m", "worst_m")
    table = [(place, *(f"{100.0 * of[key]:.0f} cm" for key in keys)) for place, of in rows]
    said = "Drift is |y| at the end, y = 0 the middle of the way, to which robots are steered."
    return join(paragraph(said), markup.table(columns, table))


def parts(rates: Sequence[tuple[str, str, float]]) -> Html:
    """Return success with one part of the randomisation alone: a row a part, a column a place."""
    names = list(dict.fromkeys(name for name, _, _ in rates))
    places = list(dict.fromkeys(place for _, place, _ in rates))
    of = {(name, place): f"{100.0 * rate:.1f} %" for name, place, rate in rates}
    columns = [Column("randomised"), *(Column(place, True) for place in places)]
    return markup.table(columns, [(n, *(of.get((n, p), MISSING) for p in places)) for n in names])


def commands(rows: Sequence[Row]) -> Html:
    """Return how each command was obeyed."""
    columns = [Column("told: forward, left m/s, turn rad/s")]
    columns += [Column(n, True) for n in ("does", "error", "fell", "feet up, left and right")]
    said = lambda values: MISSING if values is None else ", ".join(f"{x:.2f}" for x in values)
    shares = lambda of: MISSING if of is None else ", ".join(f"{100.0 * x:.1f} %" for x in of)
    table = [
        (
            said(row["command"]),
            said(row["velocity"]),
            said(row["error"]),
            f"{row['fell']} of {row['trials']}",
            shares(row["airborne"]),
        )
        for row in rows
    ]
    return markup.table(columns, table)
