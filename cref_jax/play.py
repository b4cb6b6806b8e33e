"""Watch a robot walk: `python -m cref_jax.play --run runs/NAME`, or drive it with `--live`.

Without a run, `--agent stand` shows the robot, and `--policy mixed --terrain stairs` a lane.
"""

import cref_jax.system.startup  # noqa: F401

import dataclasses
import functools
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from rich.progress import track

from cref_jax import cli, config, network, ppo, robot
from cref_jax.config import Config, limits
from cref_jax.config.ranges import Within
from cref_jax.env import footholds
from cref_jax.env.world import World, build_world
from cref_jax.errors import ConfigError
from cref_jax.evaluation import protocol
from cref_jax.live import server
from cref_jax.live.server import Settings
from cref_jax.live.stage import Place
from cref_jax.policy import sources
from cref_jax.rendering import policy_overlay, robot_scene, video
from cref_jax.system import jax_setup
from cref_jax.terrain import lanes, map_files
from cref_jax.terrain.atlas import Atlas
from cref_jax.terrain.kind_files import terrain_names
from cref_jax.training import rollout

T = TypeVar("T")
Agent = Literal["trained", "stand", "random"]
Level = int | Literal["easy", "medium", "hard", "ood"]

FRAME_RATE = 25.0  # 1/s
WIDTH, HEIGHT = 960, 540  # pixels of the video
STILL_WIDTH = 480  # pixels of one still; its height is HEIGHT
SPEED = 0.6  # m/s forward; assumed: the middle of Sec. III-A

ENDINGS = {  # of an episode, by its name in state.Ending
    "tilted": "fell, tilted too far",
    "low": "fell, its pelvis too low",
    "hit": "fell, its upper body on the ground",
    "dropped": "stepped far below its support",
    "unstable": "blew up in the simulation",
    "stalled": "stalled",
    "finished": "came to the end of the lane",
    "timeout": "ran out of time",
}


@dataclass(frozen=True)
class Options(cli.PolicyOptions):
    """Film one robot walking along a lane, without noise or pushes."""

    agent: Agent = "trained"
    """trained: a policy; stand: hold the nominal pose; random: the noise of an untrained policy"""
    terrain: Annotated[
        str | None,
        tyro.conf.arg(
            help=f"{', '.join(terrain_names())}, or a height map (default: the run's own)"
        ),
    ] = None
    kind: str | None = None
    """kind of lane, such as stairs_down (default: the terrain's first)"""
    level: Level | None = None
    """0 (easiest) to 9, or the name of a size of Table II (default: the middle one)"""
    command: Annotated[float | None, Within(-10, 10)] = None
    """m/s forward (default: 0.6; with --live that of a trial of `sim2sim`, drawn from --seed)"""
    seconds: Annotated[float, Within(0.02, 600)] = 10.0
    """length of the film; it ends earlier where the robot falls or the lane ends"""
    seed: Annotated[int, limits.SEED] = 0
    """seed of the initial state and of the random agent"""
    stills: Annotated[int, Within(0, 100)] = 0
    """write N stills side by side instead of a video"""
    out: Path | None = None
    """.mp4, or .png for stills (default: play.mp4 in the run's folder)"""
    live: bool = False
    """instead of a film, a page in the browser on which to drive the whole robot"""
    scene: str | None = None
    """with --live: a scene of `eval --suite ood`, such as curbs, instead of a lane"""
    host: str = "127.0.0.1"
    """address that the page listens on; the default is this machine alone"""
    port: Annotated[int, Within(1, 65535)] = 8080
    """port of the page; if it is taken, the next free one"""
    browser: bool = False
    """with --live: open the page in the browser, where this machine has a desktop"""


class Recording(NamedTuple):
    """One robot until the end of its episode or of the time."""

    qpos: Float[np.ndarray, "T Q"]  # before each control step
    airborne: Bool[np.ndarray, "T F"]
    marks: Float[np.ndarray, "T F K 3"]  # m, where each foot may step; NaN where it may not
    minds: "PolicyView | None"  # None: no trained policy
    progress: float  # m along the lane
    ending: str | None  # a field of episode.Ending; None: the time was over


class PolicyView(NamedTuple):
    """Inputs and inner state of a policy per step; a blind one has only a gate."""

    gate: Float[Array | np.ndarray, "*T D"]
    depth: Float[Array | np.ndarray, "*T H W"] | None  # D
    seen: Bool[Array | np.ndarray, "*T"]  # there was a frame
    attention: Float[Array | np.ndarray, "*T N"] | None  # mean over the heads


class Step(NamedTuple):
    """The record of one control step."""

    qpos: Float[Array, " Q"]  # before it
    airborne: Bool[Array, " F"]
    marks: Float[Array, "F K 3"]
    mind: PolicyView | None
    progress: Float[Array, ""]  # m
    ending: dict[str, Bool[Array, ""]]


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a mistake in it is one line and exit code 2."""
    with cli.one_line_errors(arguments):
        options = cli.parse(Options, arguments, "play")
        jax_setup.prepare()
        if not jax.config.jax_platforms:  # one robot needs no GPU, and leaves it to training
            jax.config.update("jax_platforms", "cpu")
        (drive if options.live else play)(options)


def play(options: Options) -> None:
    """Simulate, film and summarise one episode."""
    if options.scene:
        raise ConfigError("--scene goes with --live; eval --suite ood --film films one")
    is_trained = options.agent == "trained"
    choose = lambda: sources.resolve_policy(options.run, options.policy, options.robot)
    source = choose() if is_trained or options.run else None
    c = sources.read_config(source) if source else robot.fill_in(Config(), options.robot)
    suffix = ".png" if options.stills else ".mp4"
    folder = source if source and sources.is_run(source) else Path()
    out = cli.prepare_output(options.out or folder / f"play{suffix}", suffix)
    world = _build_world(options, c)
    policy = sources.load(source, world) if source and is_trained else None
    if source and policy:
        print(sources.describe(source, policy), flush=True)
    train = policy.train if policy else None
    period = c.physics.control_period
    model = robot_scene.build(
        robot.moving(c.robot), c.physics, world.lanes.tile(0, 0), c.robot.name
    )
    with robot_scene.Canvas(model, STILL_WIDTH if options.stills else WIDTH, HEIGHT) as canvas:
        recording = record(world, train, options)
        if options.stills:
            moments = np.linspace(0, len(recording.qpos) - 1, options.stills).round().astype(int)
            video.write_stills(out, _film(canvas, recording._replace(minds=None), moments, c))
        else:
            stride = max(1, round(1.0 / (FRAME_RATE * period)))
            moments = np.arange(0, len(recording.qpos), stride)
            video.write_video(out, _film(canvas, recording, moments, c), 1.0 / (stride * period))
    print(f"wrote {out}")
    print(summary(recording, _speed(options), period))


def drive(options: Options) -> None:
    """Serve the page on which people drive the robot, until Ctrl-C."""
    if options.agent != "trained" or options.stills or options.out:
        raise ConfigError("--live goes without --agent, --stills and --out")
    if options.scene and (options.terrain or options.kind or options.level is not None):
        raise ConfigError("--scene goes without --terrain, --kind and --level")
    source = sources.resolve_policy(options.run, options.policy, options.robot)
    c = sources.read_config(source)
    terrain = options.terrain or c.terrain.name
    if options.scene:
        place = Place(scene=options.scene)
    elif map_files.is_map(terrain):
        place = Place(map=Path(terrain))
    else:
        atlas = _build_lane(dataclasses.replace(c.terrain, name=terrain), options)
        kind = options.kind or atlas.kinds[0]
        place = Place(kind, float(atlas.sizes[0, atlas.kinds.index(kind)]), terrain)
    address = options.host, options.port, options.browser
    server.serve(Settings(source, place, options.seed, options.command, *address))


def record(world: World, train: ppo.TrainState | None, options: Options) -> Recording:
    """Simulate one robot until its episode or the time ends."""
    key_start, key_act = jax.random.split(jax.random.key(options.seed))
    robots = jax.jit(rollout.start)(world, key_start[None])
    robots = robots.replace(env=robots.env.replace(step=jnp.zeros_like(robots.env.step)))
    steps: list[Step] = []
    count = max(1, round(options.seconds / world.config.physics.control_period))
    for key in _with_progress(jax.random.split(key_act, count), "walking"):
        robots, step = _advance(world, options.agent, train, robots, key)
        steps.append(jax.tree.map(np.asarray, step))
        if any(steps[-1].ending.values()):
            break
    over = [name for name, flag in steps[-1].ending.items() if flag]
    return Recording(
        qpos=np.stack([step.qpos for step in steps]),
        airborne=np.stack([step.airborne for step in steps]),
        marks=np.stack([step.marks for step in steps]),
        minds=jax.tree.map(lambda *x: np.stack(x), *(step.mind for step in steps)),
        progress=float(steps[-1].progress),
        ending=over[0] if over else None,
    )


def summary(recording: Recording, command: float, period: float) -> str:
    """Summarise a recording in two lines."""
    seconds = len(recording.qpos) * period
    left, right = recording.airborne.mean(axis=0)
    fate = ENDINGS[recording.ending] if recording.ending else "was still on its feet"
    return (
        f"walked {recording.progress:.2f} m in {seconds:.1f} s, {recording.progress / seconds:.2f} "
        f"of {command:.2f} m/s asked for, and {fate}\n"
        f"off the ground: left foot {left:.0%}, right foot {right:.0%} of the time"
    )


@functools.partial(jax.jit, static_argnames="agent")
def _advance(
    world: World,
    agent: Agent,
    train: ppo.TrainState | None,
    robots: rollout.Robots,
    key: PRNGKeyArray,
) -> tuple[rollout.Robots, Step]:
    """Step the robot with the agent's action."""
    c, mind = world.config.network, None
    if train is not None:
        after, policy, outcome = rollout.step_policy(world, train, robots)
        mind = _view_policy(c, robots, policy)
    else:
        action = jnp.zeros((1, world.physics.robot.num_joints))
        if agent == "random":
            action = c.initial_std * jax.random.normal(key, action.shape)
        after, outcome = rollout.env_step(world, robots, robots.memory, action)
    step = Step(
        qpos=robots.env.body.qpos[0],
        airborne=outcome.measures.airborne[0],
        marks=footholds.points(jax.tree.map(lambda x: x[0], robots.env.candidates)),
        mind=mind,
        progress=outcome.measures.progress[0],
        ending={name: flag[0] for name, flag in outcome.ending._asdict().items()},
    )
    return after, step


def _view_policy(c: config.Network, robots: rollout.Robots, policy: network.Output) -> PolicyView:
    """Collect what the first robot's policy sees and does."""
    feed, weights = robots.feed, policy.attention
    return PolicyView(
        gate=policy.gate[0, 0],
        depth=None if feed is None else feed.images(c)[0].astype(jnp.float32),
        seen=jnp.zeros((), bool) if feed is None else feed.seen[0],
        attention=None if weights is None else weights[0, 0].mean(axis=0),
    )


def _speed(options: Options) -> float:
    """Return the speed asked for, m/s."""
    return SPEED if options.command is None else options.command


def _build_world(options: Options, c: Config) -> World:
    """Build a world of one lane, with evaluation settings."""
    c = dataclasses.replace(
        c, terrain=dataclasses.replace(c.terrain, name=options.terrain or c.terrain.name)
    )
    atlas = _build_lane(c.terrain, options)
    c = protocol.evaluation_config(c, seconds=options.seconds + 1.0)  # it does not end by itself
    speed = _speed(options)
    c = dataclasses.replace(c, command=dataclasses.replace(c.command, lane_vx=(speed, speed)))
    return build_world(c, "mujoco").replace(lanes=atlas)


def _build_lane(c: config.Terrain, options: Options) -> Atlas:
    """Build the lane that the options name.

    Raises:
        ConfigError: there is no such terrain, kind or level.
    """
    atlas = lanes.build(c)
    kind = options.kind or atlas.kinds[0]
    if kind not in atlas.kinds:
        raise ConfigError(config.describe_unknown("kind", kind, list(atlas.kinds)))
    level = atlas.levels // 2 if options.level is None else options.level
    if isinstance(level, str):
        named = lanes.named_sizes(c, kind)
        if not named:
            raise ConfigError(f"'{kind}' has no level '{level}'; take 0 to {atlas.levels - 1}")
        return lanes.build_single(c, kind, named[level])
    if not 0 <= level < atlas.levels:
        raise ConfigError(f"--level must be 0 to {atlas.levels - 1}, not {level}")
    if atlas.sizes.size == 1:
        return atlas
    return lanes.build_single(c, kind, float(atlas.sizes[level, atlas.kinds.index(kind)]))


def _film(
    canvas: robot_scene.Canvas, recording: Recording, moments: Int[np.ndarray, " n"], c: Config
) -> Iterator[robot_scene.Frame]:
    """Yield pictures of the robot at regular steps, with the panel beside it."""
    period = c.physics.control_period
    points = robot_scene.camera_path(recording.qpos, period)
    for t in _with_progress(moments, "drawing"):
        world = canvas.draw(recording.qpos[t], points[t], recording.marks[t])
        minds = recording.minds
        if minds is None:
            yield world
            continue
        upto = max(0, t + 1 - round(policy_overlay.SECONDS / period))
        mind = policy_overlay.PolicyView(
            depth=minds.depth[t] if minds.depth is not None and minds.seen[t] else None,
            attention=None if minds.attention is None else minds.attention[t],
            gates=np.asarray(minds.gate[upto : t + 1]),
        )
        side = policy_overlay.draw(
            mind, HEIGHT, c.camera.d_max, period, sees=minds.depth is not None
        )
        yield np.concatenate([world, side], axis=1)


def _with_progress(items: Iterable[T], title: str) -> Iterable[T]:
    """Yield the items, with a progress bar on a terminal."""
    return track(items, title, transient=True, disable=not sys.stdout.isatty())


if __name__ == "__main__":
    main()
