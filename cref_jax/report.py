"""Report a run or a policy as one page: `python -m cref_jax.report --run runs/NAME`."""

import cref_jax.system.startup  # noqa: F401

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cref_jax import cli, deploy
from cref_jax.errors import ConfigError
from cref_jax.pages import markup, run_page
from cref_jax.pages.markup import Column, Html, Section, code, join
from cref_jax.policy import sources


@dataclass(frozen=True)
class Options(cli.PolicyOptions):
    """Write one self-contained page about a run or an exported policy."""

    out: Path | None = None
    """page to write, .html (default: report.html in the run's folder, or policy.html here)"""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a mistake in it is one line and exit code 2."""
    with cli.one_line_errors(arguments):
        options = cli.parse(Options, arguments, "report")
        if options.out:
            cli.prepare_output(options.out, ".html")
        source = sources.resolve_policy(options.run, options.policy, options.robot)
        with contextlib.suppress(ConfigError):  # a damaged run still gets a page of what is left
            print(sources.summarize(source), flush=True)
        if options.policy or (options.run is None and not sources.is_run(source)):
            out, document = options.out or Path("policy.html"), _policy_document(source)
        else:
            out = options.out or source / "report.html"
            document = run_page.document(run_page.read(source))
        markup.write(out, document)
        print(f"wrote {out}, {out.stat().st_size / 1000:,.0f} kB; open it in any browser")


def _policy_document(path: Path) -> str:
    """Build the page of an exported policy.

    Raises:
        ConfigError: it is none.
    """
    try:
        content, _ = deploy.contents(path)
    except deploy.PolicyFormatError as error:
        raise ConfigError(str(error)) from None
    origin = content["provenance"]
    record = content.get("evaluation")
    sections = [
        Section("What it is", _overview(content, path)),
        Section("Joints", _joints(content)),
        Section("Where it comes from", run_page.provenance_body((origin["trained_by"],))),
        Section("Settings", run_page.settings_body(origin["config"])),
        Section("Evaluation", run_page.evaluation_body(record, "manifest.json"))
        if record
        else Section("Evaluation", markup.note("None was there when it was exported.")),
    ]
    lead = markup.tiles(
        [
            (f"{origin['iteration']:,}", "iterations"),
            (f"{origin['samples'] / 1e6:.1f} M", "samples"),
            (content["network"]["variant"], "network"),
        ]
    )
    return markup.document(f"Policy {path.resolve().name}", lead, sections, run_page.footer())


def _overview(content: dict[str, Any], path: Path) -> Html:
    """Describe inputs and origin of an exported policy."""
    origin, rates, command = content["provenance"], content["rates"], content["command"]
    ends = zip(command["low"], command["high"], strict=True)
    limits = [f"{low:g} to {high:g}" for low, high in ends]
    return markup.definition_list(
        [
            ("folder", code(str(path))),
            ("run", str(origin["run"])),
            ("exported", run_page.format_time(origin["exported"])),
            ("control", f"{rates['control_hz']:g} Hz"),
            ("depth", f"{rates['depth_hz']:g} Hz" if content.get("depth") else "none: it is blind"),
            ("command forward", f"{limits[0]} m/s"),
            ("command to the left", f"{limits[1]} m/s"),
            ("command of the yaw rate", f"{limits[2]} rad/s"),
            ("digest", code(str(content["digest"]))),
        ]
    )


def _joints(content: dict[str, Any]) -> Html:
    """Tabulate the joints driven by the policy and those held by the robot."""
    keys = ("default_rad", "low_rad", "high_rad", "kp", "kd", "effort_nm")
    titles = (
        "default, rad",
        "low, rad",
        "high, rad",
        "kp, N m/rad",
        "kd, N m s/rad",
        "effort, N m",
    )
    columns = [Column("joint"), *(Column(title, True) for title in titles)]
    number = lambda joint, key: f"{joint[key]:.4g}" if key in joint else markup.MISSING
    rows = lambda joints: [(j["name"], *(number(j, key) for key in keys)) for j in joints]
    driven, held = content["joints"], content["held_joints"]
    return join(
        markup.collapsible(
            f"{len(driven)} joints that it drives", markup.table(columns, rows(driven))
        ),
        markup.collapsible(
            f"{len(held)} joints that the robot holds", markup.table(columns, rows(held))
        ),
    )


if __name__ == "__main__":
    main()
