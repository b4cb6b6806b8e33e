"""The page of a run: what its folder holds, for people. Nothing of it needs a device.

What is missing or damaged leaves its section out, with a line that says how to get it.
"""

import dataclasses
import datetime
import json
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from cref_jax.config import Config
from cref_jax.errors import ConfigError
from cref_jax.pages import evaluation_page, learning_charts, markup, training_log
from cref_jax.pages.markup import MISSING, Column, Html, Section, code, join, note, paragraph
from cref_jax.pages.training_log import Log

MOST_MEDIA = (
    60 * markup.MEGABYTE
)  # bytes of all pictures and films of one page; assumed: as MOST_VIDEO
PACKAGES = ("cref-jax", "jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy", "python")

Settings = dict[str, Any]


class Run(NamedTuple):
    """What the folder of a run holds."""

    folder: Path
    settings: Settings  # config.json, nested
    starts: tuple[dict[str, Any], ...]  # origin.jsonl
    log: Log | None
    no_log: str  # why there is none
    checkpoints: tuple[int, ...]  # iterations


def read(folder: Path) -> Run:
    """Return what is known about a run.

    Raises:
        ConfigError: it is none: there is no config.json that can be read.
    """
    path = folder / "config.json"
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise ConfigError(f"{folder} is not a run: it has no config.json") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from None
    if not isinstance(settings, dict):
        raise ConfigError(f"{path} holds no settings")
    log, why = None, ""
    try:
        log = training_log.read(folder / "log.jsonl")
    except ConfigError as error:
        why = str(error)
    steps = sorted(int(p.name) for p in (folder / "checkpoints").glob("*") if p.name.isdecimal())
    return Run(folder, settings, tuple(_starts(folder)), log, why, tuple(steps))


def document(run: Run) -> str:
    """Return the page of a run."""
    sections = [
        Section("What it is", _overview(run)),
        *_evaluations(run),
        Section("Pictures and films", _media(run.folder)),
        *_learning(run),
        Section("Where it comes from", provenance(run.starts)),
        Section("Settings", settings(run.settings)),
    ]
    return markup.document(f"Run {run.folder.resolve().name}", _lead(run), sections, foot())


def foot() -> str:
    """Return when a page was written."""
    now = datetime.datetime.now(datetime.UTC)
    return f"Written by cref_jax on {now:%Y-%m-%d at %H:%M} UTC."


def settings(given: Settings) -> Html:
    """Return the settings that differ from the defaults, and all of them on a click."""
    ours, defaults = _flat(given), _flat(json.loads(json.dumps(dataclasses.asdict(Config()))))
    names = list(dict.fromkeys([*defaults, *ours]))
    changed = [name for name in names if ours.get(name) != defaults.get(name)]
    shown = lambda values, name: json.dumps(values[name]) if name in values else MISSING
    columns = [Column("setting"), Column("here"), Column("default")]
    rows = [(code(name), shown(ours, name), shown(defaults, name)) for name in changed]
    everything = [(code(name), json.dumps(value)) for name, value in ours.items()]
    return join(
        paragraph("These settings differ from the defaults, which are the paper's.")
        if changed
        else paragraph("Every setting is the default, which is the paper's."),
        markup.table(columns, rows) if changed else Html(),
        markup.folded(f"All {len(ours)} settings", markup.table(columns[:2], everything)),
    )


def provenance(starts: tuple[Mapping[str, Any], ...]) -> Html:
    """Return when, how and with what a run was started."""
    if not starts:
        return note("It is not known: origin.jsonl is missing or empty.")
    columns = [Column("start"), Column("done before", True), Column("command")]
    columns += [Column("device"), Column("cores", True), Column("git")]
    rows = [
        (
            moment(start.get("time")),
            _count(start.get("iteration")),
            code(_command(start.get("command"))),
            str(start.get("device", MISSING)),
            str(start.get("cores", MISSING)),
            _git(start.get("git")),
        )
        for start in starts
    ]
    versions = [
        f"{name} {', then '.join(dict.fromkeys(str(s[name]) for s in starts if name in s))}"
        for name in PACKAGES
        if any(name in start for start in starts)
    ]
    made_by = paragraph(f"Versions: {'; '.join(versions)}.") if versions else Html()
    return join(markup.table(columns, rows), made_by)


def evaluation(record: Any, source: str, iteration: int | None = None) -> Html:
    """Return an evaluation inside of another page; `iteration` is the newest of its run."""
    try:
        if not isinstance(record, dict):
            raise ConfigError("this evaluation is no table of values")
        shown = [evaluation_page.lead(record), markup.nested(evaluation_page.sections(record))]
    except ConfigError as error:
        return note(code(source), f": {error}.")
    of = record.get("iteration")
    if iteration is not None and isinstance(of, int) and of < iteration:
        shown.insert(0, note(f"It is of iteration {of:,}; the run has come to {iteration:,}."))
    return join(*shown)


def moment(iso: Any) -> str:
    """Return a time as people write it."""
    return str(iso or MISSING).replace("T", " ").replace("+00:00", " UTC")


def _starts(folder: Path) -> Iterator[dict[str, Any]]:
    try:
        lines = (folder / "origin.jsonl").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return
    for line in lines:
        try:
            start = json.loads(line)
        except ValueError:
            continue
        if isinstance(start, dict):
            yield start


def _lead(run: Run) -> Html:
    """Return the few figures of a run."""
    if run.log is None:
        return Html()
    log = run.log
    of = _of(run.settings, "run", "iterations")
    values = [(f"{int(log['iteration'][-1]):,}", f"iterations of {_count(of)}")]
    if "train/samples" in log:
        values.append((f"{log['train/samples'][-1] / 1e6:.1f} M", "samples"))
        if "samples_per_s" in log:
            values.append((_duration(float(log.minutes()[-1])), "of training"))
    return markup.tiles([*values, *learning_charts.newest(log)])


def _overview(run: Run) -> Html:
    """Return what kind of run it is and how far it has come."""
    of = lambda *path: _of(run.settings, *path)
    values = [
        ("folder", code(str(run.folder))),
        ("terrain", _text(of("terrain", "name"))),
        ("network", _text(of("network", "variant"))),
        ("robots at once", _count(of("run", "num_envs"))),
        ("seed", _text(of("run", "seed"))),
        ("state", _state(run)),
    ]
    if run.checkpoints:
        values.append(("checkpoints", ", ".join(f"{step:,}" for step in run.checkpoints)))
    return markup.pairs(values)


def _state(run: Run) -> str:
    """Return whether the run is finished."""
    total = _of(run.settings, "run", "iterations")
    if run.log is None or not isinstance(total, int):
        return "nothing is logged yet"
    done = int(run.log["iteration"][-1])
    seconds = (run.folder / "log.jsonl").stat().st_mtime
    last = datetime.datetime.fromtimestamp(seconds, datetime.UTC)
    when = f"the log's last line is of {last:%Y-%m-%d %H:%M} UTC"
    if done >= total:
        return f"finished: {done:,} of {total:,} iterations; {when}"
    return f"stopped or still training: {done:,} of {total:,} iterations; {when}"


def _learning(run: Run) -> Iterator[Section]:
    if run.log is None:
        words = note(f"{run.no_log}. Training writes it: ", _make("train", run.folder, "--resume"))
        yield Section("Learning curves", words)
        return
    done = [start.get("iteration") for start in run.starts[1:]]
    marks = sorted({*run.log.repeated, *(i + 1 for i in done if isinstance(i, int))})
    target = _of(run.settings, "ppo", "target_kl")
    yield from learning_charts.sections(
        run.log, marks, float(target) if isinstance(target, int | float) else None, len(run.starts)
    )


def _evaluations(run: Run) -> Iterator[Section]:
    """Return the newest evaluation of each suite."""
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
        yield Section(title, evaluation(record, name, newest))
    if older:
        yield Section("Older evaluations", paragraph(", ".join(older)))
    if not shown:
        words = note("There is none yet: ", _make("eval", run.folder, "--suite table"))
        yield Section("Evaluation", words)


def _media(folder: Path) -> Html:
    """Return the pictures and films of the folder, the newest first, while there is room."""
    kinds = (".png", ".mp4")
    files = [p for p in folder.iterdir() if p.suffix.lower() in kinds and p.is_file()]
    files.sort(key=lambda p: (-p.stat().st_mtime, p.name))
    left, shown = MOST_MEDIA, []
    for path in files:
        film = path.suffix.lower() == ".mp4"
        most = min(left, markup.MOST_VIDEO if film else markup.MOST_PICTURE)
        shown.append(markup.media(path, most))
        size = path.stat().st_size
        left -= size if size <= most else 0
    if not any(path.suffix.lower() == ".mp4" for path in files):
        shown.append(note("There is no film of it yet: ", _make("play", folder)))
    return join(*shown)


def _make(target: str, folder: Path, *more: str) -> Html:
    """Return the command that makes what is missing."""
    option = "--run-dir" if target == "train" else "--run"
    words = " ".join((option, shlex.quote(str(folder)), *more))
    return code(f"make {target} ARGS={shlex.quote(words) if chr(39) in words else repr(words)}")


def _command(words: Any) -> str:
    """Return a command line as it is typed, without the folders of another machine."""
    if not isinstance(words, list) or not words:
        return MISSING
    program, *rest = map(str, words)
    name = Path(program).name
    start = f"python -m cref_jax.{Path(name).stem}" if name.endswith(".py") else name
    return " ".join((start, *map(shlex.quote, rest)))


def _git(state: Any) -> Html:
    if not isinstance(state, str) or not state:
        return Html("unknown")
    commit = state.removesuffix("+")
    return join(code(commit[:12]), " with changes" if state.endswith("+") else "")


def _flat(nested: Settings, before: str = "") -> Settings:
    """Return nested settings under dotted names."""
    flat: Settings = {}
    for name, value in nested.items():
        path = f"{before}{name}"
        flat |= _flat(value, f"{path}.") if isinstance(value, dict) else {path: value}
    return flat


def _of(settings: Settings, *path: str) -> Any:
    value: Any = settings
    for name in path:
        value = value.get(name) if isinstance(value, dict) else None
    return value


def _text(value: Any) -> str:
    return MISSING if value is None else str(value)


def _count(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else _text(value)


def _duration(minutes: float) -> str:
    whole = round(minutes)
    return f"{whole // 60} h {whole % 60} min" if whole >= 60 else f"{whole} min"
