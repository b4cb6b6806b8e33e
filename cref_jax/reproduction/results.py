"""The results of a plan beside the paper's: one record, of which the page is made.

What is over seeds is a `Few`: each seed's value, their mean, standard deviation and Student's t
interval. Rates are fractions, lengths in m. An unfinished row has no part in it.
"""

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cref_jax.evaluation import highway_gate, intervals, paper_results, tables
from cref_jax.evaluation.intervals import Rate
from cref_jax.reproduction import levels, progress
from cref_jax.reproduction.plan import Plan, Row

Record = dict[str, Any]

PAPER_TRIALS = paper_results.TRIALS // 2  # in each direction of stairs
MAD_SIZE = tables.cell_sizes()["stairs"]["hard"]  # m, Sec. III-B
MUCH = 0.1  # share by which a variant's parameters differ that the page points out
COMPARED = (  # states whose difference of gates the paper finds above 0, Sec. III-B
    ("stairs up", "flat"),
    ("stairs down", "flat"),
    ("flight", "double support"),
    ("risky", "stable"),
)


def build_record(folder: Path, plan: Plan, parameters: Mapping[str, Mapping[str, int]]) -> Record:
    """Build the record of what the folder holds; `parameters` by variant: policy and critic."""
    learned = {row: levels.read_levels(folder, plan, row) for row in plan.rows}
    rows = [{**_describe_row(folder, plan, row), "curves": learned[row]} for row in plan.rows]
    evaluated = {
        row: {s: progress.read_evaluation(folder, plan, row, s) for s in progress.suites(plan, row)}
        for row in plan.rows
        if progress.is_finished(folder, plan, row)
    }
    of = lambda values, variant: {r.seed: values[r] for r in evaluated if r.variant == variant}
    variants = [
        {
            **_summarize_variant(name, of(evaluated, name), len(plan.seeds), parameters),
            "levels": _levels(list(of(learned, name).values())),
        }
        for name in plan.variants
    ]
    return {
        "terrain": plan.terrain,
        "device": plan.device,
        "seeds": list(plan.seeds),
        "trials": plan.trials,
        "settings": list(plan.settings),
        "samples": plan.samples(plan.rows[0]),
        "paper_samples": paper_results.SAMPLES,
        "paper_trials": paper_results.TRIALS,
        "rule": tables.RULE,
        "gate_rule": highway_gate.RULE,
        "variants": variants,
        "rows": rows,
    }


def over_seeds(values: Sequence[float], low: float = -math.inf, high: float = math.inf) -> Record:
    """Summarize one value per seed: a `Few`, its interval cut to what is possible."""
    interval = intervals.mean_of_few(values) if values else None
    return {
        "each": list(values),
        "mean": statistics.fmean(values) if values else None,
        "deviation": statistics.stdev(values) if len(values) > 1 else None,
        "low": max(interval.low, low) if interval else None,
        "high": min(interval.high, high) if interval else None,
    }


def _describe_row(folder: Path, plan: Plan, row: Row) -> Record:
    """Describe how far a row is; times vary between equal runs."""
    speed = progress.measure_speed(folder, plan, row)
    found = [progress.read_evaluation(folder, plan, row, s) for s in progress.suites(plan, row)]
    last = plan.configs[row.variant].run.iterations
    done = min(progress.count_trained(folder, row), last)
    return {
        "row": row.name,
        "variant": row.variant,
        "seed": row.seed,
        "samples": plan.samples(row) * done // last,
        "planned": plan.samples(row),
        "finished": progress.is_finished(folder, plan, row),
        "samples_per_s": speed.rate,
        "training_s": speed.seconds,
        "evaluation_s": sum(record["seconds"] for record in found if record),
    }


def _summarize_variant(
    variant: str,
    evaluated: Mapping[int, Mapping[str, Any]],
    planned: int,
    parameters: Mapping[str, Mapping[str, int]],
) -> Record:
    """Summarize the evaluations of a variant's finished seeds, by suite; `planned` seeds in all."""
    of_table = [of["table"] for of in evaluated.values()]
    own, full = parameters[variant]["policy"], parameters.get("full", {}).get("policy")
    return {
        "variant": variant,
        "seeds": list(evaluated),
        "planned": planned,
        "parameters": own,
        "critic_parameters": parameters[variant]["critic"],
        "parameters_of_full": own / full if full else None,
        "other_size": full is not None and abs(own / full - 1.0) > MUCH,
        "paper": paper_results.VARIANTS.get(variant),
        **({"success": _success(variant, of_table)} if of_table else {}),
        **({"stairs": list(_stairs(variant, of_table))} if of_table else {}),
        "touchdowns": [_touchdowns(variant, of_table, way) for way in ("up", "down")],
        "gate": _gate([of["gate"]["gate"] for of in evaluated.values() if "gate" in of]),
    }


def _levels(learned: Sequence[Record | None]) -> Record:
    """Summarize the last level on each kind of lane."""
    logged = [of["levels"] for of in learned if of]
    kinds = list(logged[0]) if logged else []  # all rows have one terrain
    last = {kind: [of[kind][-1] for of in logged] for kind in kinds}
    return {k: over_seeds([x for x in each if x is not None], 0.0) for k, each in last.items()}


def _success(variant: str, records: Sequence[Record]) -> Record:
    """Summarize Table II: each cell over seeds and over all trials, and their mean."""
    method = paper_results.METHODS.get(paper_results.VARIANTS.get(variant, ""))
    cells, rates = [], []
    for number, first in enumerate(records[0]["cells"]):
        rows = [record["cells"][number] for record in records]
        cell = first["kind"], first["level"]
        trials, successes = (sum(row[key] for row in rows) for key in ("trials", "successes"))
        rates.append(intervals.wilson(successes, trials))
        cells.append(
            {
                **{key: first[key] for key in ("kind", "level", "size_m")},
                "seeds": over_seeds([row["rate"] for row in rows], 0.0, 1.0),
                **_count(successes, trials),
                "paper": method.success[cell] / 100.0 if method else None,
            }
        )
    whole = intervals.mean(rates)
    return {
        "cells": cells,
        "overall": {
            "seeds": over_seeds([record["overall"]["rate"] for record in records], 0.0, 1.0),
            **_interval(whole),
            "paper": method.overall / 100.0 if method else None,
        },
    }


def _stairs(variant: str, records: Sequence[Record]) -> Iterator[Record]:
    """Summarize Table III: failures in each direction of stairs."""
    method = paper_results.METHODS.get(paper_results.VARIANTS.get(variant, ""))
    for way in ("up", "down"):
        for number, level in enumerate(paper_results.LEVELS):
            rows = [record["cells"][number] for record in records]
            # trials go up and down in turn, the first one up
            counts = [(row["trials"] + (way == "up")) // 2 for row in rows]
            failures = [row[f"{way}_failures"] for row in rows]
            shares = [lost / n for lost, n in zip(failures, counts, strict=True) if n]
            theirs = (method.up if way == "up" else method.down)[level] if method else None
            yield {
                "way": way,
                "level": level,
                "size_m": rows[0]["size_m"],
                "failures": sum(failures),
                "seeds": over_seeds(shares, 0.0, 1.0),
                **_count(sum(failures), sum(counts)),
                "paper": None if theirs is None else theirs / PAPER_TRIALS,
            }


def _touchdowns(variant: str, records: Sequence[Record], way: str) -> Record:
    """Summarize where feet land on hard stairs: MAD of both feet."""
    groups = [
        group
        for record in records
        for group in (record.get("touchdowns") or {"groups": []})["groups"]
        if (group["way"], group["foot"]) == (way, "both")
        and math.isclose(group["size_m"], MAD_SIZE)
        and group["mad_m"] is not None
    ]
    return {
        "way": way,
        "size_m": MAD_SIZE,
        "touchdowns": sum(group["touchdowns"] for group in groups),
        "mad_m": over_seeds([group["mad_m"] for group in groups], 0.0),
        "paper_m": paper_results.DESCENT_MAD.get(variant) if way == "down" else None,
    }


def _gate(records: Sequence[Sequence[Record]]) -> Record | None:
    """Summarize the gate: its mean in each state, and the differences that the paper names."""
    if not records:
        return None
    means = [{row["state"]: row["mean"] for row in rows} for rows in records]
    gaps = lambda a, b: [m[a] - m[b] for m in means if None not in (m[a], m[b])]
    return {
        "states": [
            {
                "group": row["group"],
                "state": row["state"],
                "steps": sum(rows[number]["n"] for rows in records),
                "mean": over_seeds([m[row["state"]] for m in means if m[row["state"]] is not None]),
            }
            for number, row in enumerate(records[0])
        ],
        "differences": [
            {"higher": a, "lower": b, "difference": over_seeds(gaps(a, b))} for a, b in COMPARED
        ],
    }


def _count(successes: int, trials: int) -> Record:
    return {"trials": trials, **_interval(intervals.wilson(successes, trials))}


def _interval(rate: Rate) -> Record:
    value = None if math.isnan(rate.value) else rate.value  # JSON has no NaN
    return {"rate": value, "wilson_low": rate.low, "wilson_high": rate.high}
