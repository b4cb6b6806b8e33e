"""The page of a run: the contents of its folder for human readers. It needs no JAX device.

A section whose data is missing or damaged holds a note with the command that creates the data.
"""

import dataclasses
import datetime
import json
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from cref_jax.config import Config, folders
from cref_jax.errors import ConfigError
from cref_jax.pages import evaluation_page, learning_charts, markup, training_log
from cref_jax.pages.markup import MISSING, Column, Html, Section, code, join, note, paragraph
from cref_jax.pages.training_log import Log
from cref_jax.system import disk

MOST_MEDIA = 12 * markup.MEGABYTE  # bytes of all images and videos per page; assumed: as MOST_VIDEO
PACKAGES = ("cref-jax", "jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy", "python")

Settings = dict[str, Any]


class RunRecord(NamedTuple):
    """The contents of a run's folder."""

    folder: Path
    settings: Settings  # config.json, nested
    starts: tuple[dict[str, Any], ...]  # origin.jsonl
    log: Log | None
    no_log: str  # why the log is missing
    checkpoints: tuple[int, ...]  # iterations


def read(folder: Path) -> RunRecord:
    """Read the settings, the starts, the log and the checkpoint numbers of a run.

    Raises:
        ConfigError: config.json is missing or unreadable.
    """
    path = folder / "config.json"
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise ConfigError(f"{folder} is not a run: it has no config.json") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from None
    if not isinstance(settings, dict):
        raise ConfigError(f"{path} has no settings")
    log, reason = None, ""
    try:
        log = training_log.read(folder / "log.jsonl")
    except ConfigError as error:
        reason = str(error)
    steps = sorted(int(p.name) for p in (folder / "checkpoints").glob("*") if p.name.isdecimal())
    starts = tuple(disk.read_objects(folder / "origin.jsonl"))
    return RunRecord(folder, settings, starts, log, reason, tuple(steps))


def document(run: RunRecord) -> str:
    """Build the page of a run."""
    sections = [
        Section("Overview", _overview_list(run)),
        *_evaluation_sections(run),
        Section("Images and videos", _media_body(run.folder)),
        *_learning_sections(run),
        Section("Provenance", provenance_body(run.starts)),
        Section("Settings", settings_body(run.settings)),
    ]
    return markup.document(f"Run {run.folder.resolve().name}", _make_tiles(run), sections, footer())


def footer() -> str:
    """Format the time at which the page is written."""
    now = datetime.datetime.now(datetime.UTC)
    return f"Written by cref_jax on {now:%Y-%m-%d at %H:%M} UTC."


def settings_body(settings: Settings) -> Html:
    """Build the table of settings that differ from the defaults and, collapsed, that of all."""
    current = _flatten(settings)
    defaults = _flatten(json.loads(json.dumps(dataclasses.asdict(Config()))))
    names = list(dict.fromkeys([*defaults, *current]))
    changed = [name for name in names if current.get(name) != defaults.get(name)]
    shown = lambda values, name: json.dumps(values[name]) if name in values else MISSING
    columns = [Column("setting"), Column("value"), Column("default")]
    rows = [(code(name), shown(current, name), shown(defaults, name)) for name in changed]
    everything = [(code(name), json.dumps(value)) for name, value in current.items()]
    return join(
        paragraph("These settings differ from the defaults.")
        if changed
        else paragraph("All settings have their defaults."),
        markup.table(columns, rows) if changed else Html(),
        markup.collapsible(f"All {len(current)} settings", markup.table(columns[:2], everything)),
    )


def provenance_body(starts: tuple[Mapping[str, Any], ...]) -> Html:
    """Build the table of starts: time, command, device, commit and package versions."""
    if not starts:
        return note("Unknown: origin.jsonl is missing or empty.")
    columns = [Column("start"), Column("iterations before", True), Column("command")]
    columns += [Column("device"), Column("cores", True), Column("git")]
    rows = [
        (
            format_time(start.get("time")),
            _format_count(start.get("iteration")),
            code(_format_command(start.get("command"))),
            str(start.get("device", MISSING)),
            str(start.get("cores", MISSING)),
            _format_commit(start.get("git")),
        )
        for start in starts
    ]
    versions = [
        f"{name} {', then '.join(dict.fromkeys(str(s[name]) for s in starts if name in s))}"
        for name in PACKAGES
        if any(name in start for start in starts)
    ]
    used = paragraph(f"Versions: {'; '.join(versions)}.") if versions else Html()
    return join(markup.table(columns, rows), used)


def evaluation_body(
    record: Any, source: str, iteration: int | None = None, folder: Path | None = None
) -> Html:
    """Build an evaluation as part of another page.

    `iteration` is the run's latest checkpoint; films are files of `folder`.
    """
    try:
        if not isinstance(record, dict):
            raise ConfigError("this evaluation is not a JSON object")
        sections = evaluation_page.sections(record, folder)
        shown = [evaluation_page.lead(record), markup.subsections(sections)]
    except ConfigError as error:
        return note(code(source), f": {error}.")
    measured = _measured_iteration(record)
    if iteration is not None and measured is not None and measured < iteration:
        text = f"Measured at iteration {measured:,}; the latest checkpoint is {iteration:,}."
        shown.insert(0, note(text))
    return join(*shown)


def _measured_iteration(record: Mapping[str, Any]) -> int | None:
    """Find the iteration of an evaluation's policy, the least of several; None if unknown."""
    of = (record, *(record.get("policies") or ()))
    found = (part.get("iteration") for part in of)
    return min((number for number in found if isinstance(number, int)), default=None)


def format_time(iso: Any) -> str:
    """Format an ISO 8601 time for human readers."""
    return str(iso or MISSING).replace("T", " ").replace("+00:00", " UTC")


def _make_tiles(run: RunRecord) -> Html:
    """Build the tiles with the headline figures of a run."""
    if run.log is None:
        return Html()
    log = run.log
    of = _look_up(run.settings, "run", "iterations")
    values = [(f"{int(log['iteration'][-1]):,}", f"iterations of {_format_count(of)}")]
    if "train/samples" in log:
        values.append((f"{log['train/samples'][-1] / 1e6:.1f} M", "samples"))
        if "samples_per_s" in log:
            values.append((_format_duration(float(log.minutes()[-1])), "of training"))
    return markup.tiles([*values, *learning_charts.latest_values(log)])


def _overview_list(run: RunRecord) -> Html:
    """Build the list of a run's main settings, its progress and its checkpoints."""
    of = lambda *path: _look_up(run.settings, *path)
    values = [
        ("folder", code(str(run.folder))),
        ("terrain", _format_text(of("terrain", "name"))),
        ("network", _format_text(of("network", "variant"))),
        ("parallel robots", _format_count(of("run", "num_envs"))),
        ("seed", _format_text(of("run", "seed"))),
        ("state", _describe_progress(run)),
    ]
    if run.checkpoints:
        values.append(("checkpoints", ", ".join(f"{step:,}" for step in run.checkpoints)))
    return markup.definition_list(values)


def _describe_progress(run: RunRecord) -> str:
    """Describe the progress of the run in words."""
    total = _look_up(run.settings, "run", "iterations")
    if run.log is None or not isinstance(total, int):
        return "nothing logged yet"
    done = int(run.log["iteration"][-1])
    seconds = (run.folder / "log.jsonl").stat().st_mtime
    last = datetime.datetime.fromtimestamp(seconds, datetime.UTC)
    when = f"last logged at {last:%Y-%m-%d %H:%M} UTC"
    if done >= total:
        return f"finished: {done:,} of {total:,} iterations; {when}"
    return f"stopped or still training: {done:,} of {total:,} iterations; {when}"


def _learning_sections(run: RunRecord) -> Iterator[Section]:
    if run.log is None:
        command = _make_command("train", run.folder, "--resume")
        missing = note(f"{run.no_log}. Training writes it: ", command)
        yield Section("Learning curves", missing)
        return
    done = [start.get("iteration") for start in run.starts[1:]]
    marks = sorted({*run.log.repeated, *(i + 1 for i in done if isinstance(i, int))})
    target = _look_up(run.settings, "ppo", "target_kl")
    yield from learning_charts.sections(
        run.log, marks, float(target) if isinstance(target, int | float) else None, len(run.starts)
    )


def _evaluation_sections(run: RunRecord) -> Iterator[Section]:
    """Yield the newest evaluation of each suite."""
    shown, older = {}, []
    files = sorted(run.folder.glob("eval*.json"), key=lambda p: (-p.stat().st_mtime, p.name))
    for path in files:
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            record = None
        suite = record.get("suite") if isinstance(record, dict) else path.name
        if suite in shown:
            older.append(path.name)
        else:
            shown[suite] = (path.name, record)
    newest = max(run.checkpoints, default=None)
    order = [suite for suite in evaluation_page.TITLES if suite in shown]
    order += [suite for suite in shown if suite not in order]
    for name, record in map(shown.__getitem__, order):
        title = evaluation_page.title(record) if isinstance(record, dict) else name
        yield Section(title, evaluation_body(record, name, newest, run.folder))
    if older:
        yield Section("Older evaluations", paragraph(", ".join(older)))
    if not shown:
        command = _make_command("eval", run.folder, "--suite", "table")
        missing = note("No evaluation yet. Run ", command)
        yield Section("Evaluation", missing)


def _media_body(folder: Path) -> Html:
    """Embed the images and videos of the folder, newest first, within `MOST_MEDIA` bytes."""
    kinds = (".png", ".mp4")
    files = [p for p in folder.iterdir() if p.suffix.lower() in kinds and p.is_file()]
    files.sort(key=lambda p: (-p.stat().st_mtime, p.name))
    left, shown = MOST_MEDIA, []
    for path in files:
        is_video = path.suffix.lower() == ".mp4"
        most = min(left, markup.MOST_VIDEO if is_video else markup.MOST_PICTURE)
        shown.append(markup.media(path, most))
        size = path.stat().st_size
        left -= size if size <= most else 0
    if not any(path.suffix.lower() == ".mp4" for path in files):
        shown.append(note("No video yet. Run ", _make_command("play", folder)))
    return join(*shown)


def _make_command(target: str, folder: Path, *more: str) -> Html:
    """Format the command that creates missing data of the run."""
    option = "--run-dir" if target == "train" else "--run"
    return code(folders.command_line(target, option, folder, *more))


def _format_command(words: Any) -> str:
    """Format a recorded command line without the folder of its program."""
    if not isinstance(words, list) or not words:
        return MISSING
    program, *rest = map(str, words)
    name = Path(program).name
    start = f"python -m cref_jax.{Path(name).stem}" if name.endswith(".py") else name
    return " ".join((start, *map(shlex.quote, rest)))


def _format_commit(state: Any) -> Html:
    if not isinstance(state, str) or not state:
        return Html("unknown")
    commit = state.removesuffix("+")
    return join(code(commit[:12]), " with changes" if state.endswith("+") else "")


def _flatten(nested: Settings, before: str = "") -> Settings:
    """Flatten nested settings to dotted names."""
    flat: Settings = {}
    for name, value in nested.items():
        path = f"{before}{name}"
        flat |= _flatten(value, f"{path}.") if isinstance(value, dict) else {path: value}
    return flat


def _look_up(settings: Settings, *path: str) -> Any:
    value: Any = settings
    for name in path:
        value = value.get(name) if isinstance(value, dict) else None
    return value


def _format_text(value: Any) -> str:
    return MISSING if value is None else str(value)


def _format_count(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else _format_text(value)


def _format_duration(minutes: float) -> str:
    whole = round(minutes)
    return f"{whole // 60} h {whole % 60} min" if whole >= 60 else f"{whole} min"
