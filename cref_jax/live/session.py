"""A robot that people drive, step by step: no clock, no browser."""

import collections
import math
import threading
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from cref_jax.live.feet import Feet
from cref_jax.live.film import RATE, Film, Moment
from cref_jax.live.policies import Loaded
from cref_jax.live.stage import Stage
from cref_jax.whole_body.trial import Episode, lane_command

RESTART_AFTER = 2.0  # s, from the end of an episode to the next one
GATE_SECONDS = 4.0  # s, of the gate's history

OVER = {  # what ends an episode, in words
    "tilted": "Fell: tilted too far",
    "low": "Fell: pelvis too low",
    "hit": "Fell: body on the ground",
    "dropped": "Stepped far below its support",
    "unstable": "The simulation blew up",
    "finished": "Came to the end",
}
NOTES = {"strayed": "Off the path", "stalled": "Hardly moves"}  # what ends a trial alone


class Wish(NamedTuple):
    """What the robot is asked to do."""

    vx: float | None = None  # m/s forward; None: as its start says
    vy: float = 0.0  # m/s leftward
    yaw_rate: float = 0.0  # rad/s to the left
    keep_lane: bool = True  # steer along the lane instead of by `yaw_rate`


class View(NamedTuple):
    """What there is to see of one moment."""

    stage: Stage
    episode: int  # number of the episode, from 1
    seconds: float  # of it
    qpos: Float[np.ndarray, " Q"]
    body_position: Float[np.ndarray, "B 3"]  # m
    body_rotation: Float[np.ndarray, "B 4"]  # quaternions
    command: Float[np.ndarray, "3"]
    velocity: Float[np.ndarray, "2"]  # m/s forward and leftward, in the base's heading
    yaw_rate: float  # rad/s
    why: str  # the runtime's status in words; nothing if all is well
    note: str  # how it ended, or what would have ended a trial
    is_over: bool
    is_stopped: bool
    frame: Float[np.ndarray, "H W"] | None  # m, the newest that was delivered
    attention: Float[np.ndarray, " N"] | None
    gates: Float[np.ndarray, "T D"]  # of the last `GATE_SECONDS`
    touchdowns: list[tuple[int, np.ndarray]]  # foot, m
    soles: Float[np.ndarray, "2 3"]  # m, at their last contact
    headings: Float[np.ndarray, "2"]  # rad, at their last contact


class Session:
    """One robot. All methods may be called from any thread."""

    def __init__(self, stage: Stage) -> None:
        self._lock = threading.RLock()
        self._wish = Wish()
        self.restarts = True  # by itself, after an end
        self._count = 0  # episodes so far
        self._film: Film | None = None
        self._next_policy: Loaded | None = None
        self.begin(stage)

    def begin(self, stage: Stage) -> None:
        """Go to another stage, to its first start, with the newest state of its policy."""
        with self._lock:
            policy = stage.policy
            if self._next_policy and self._next_policy.name == policy.name:
                policy = max(self._next_policy, policy, key=lambda known: known.iteration)
            self._stage, self._policy = stage._replace(policy=policy), policy.runtime()
            self._next_policy, self._number = None, 0
            self._place_robot()

    def reset(self) -> None:
        """Place the robot at its next start."""
        with self._lock:
            self._number = (self._number + 1) % len(self._stage.starts)
            if self._next_policy:
                self._stage = self._stage._replace(policy=self._next_policy)
                self._policy, self._next_policy = self._next_policy.runtime(), None
            self._place_robot()

    def take_policy(self, policy: Loaded) -> bool:
        """Walk with a newer state of the policy from the next start on; False if another walks."""
        with self._lock:
            is_same = policy.name == self._stage.policy.name
            if is_same:
                self._next_policy = policy
            return is_same

    def drive(self, wish: Wish) -> None:
        """Ask for speeds from now on."""
        with self._lock:
            self._wish = wish

    @property
    def wish(self) -> Wish:
        """What is asked for, with the speed of the start where none is."""
        with self._lock:
            wish = self._wish
            return wish if wish.vx is not None else wish._replace(vx=self._episode.start.speed)

    @property
    def is_stopped(self) -> bool:
        """Whether it was told to stand."""
        return self._is_stopped

    def stop(self) -> None:
        """Stand until `walk`."""
        with self._lock:
            self._policy.stop()
            self._is_stopped = True

    def walk(self) -> None:
        """Walk again after `stop`: the policy begins anew."""
        with self._lock:
            if self._is_stopped:
                self._policy.reset()
                self._is_stopped = False

    def push(self, direction: float, speed: float) -> None:
        """Change the base's velocity at the next step, by `speed` in m/s.

        `direction` is where to, rad to the left of where the robot looks.
        """
        with self._lock:
            angle = _heading(self._episode.state.qpos) + direction
            self._push += speed * np.array([math.cos(angle), math.sin(angle)])

    def start_film(self) -> None:
        """Film from now on, until the ground or the policy changes or the film is full."""
        with self._lock:
            self._film = Film(self._stage, [])

    def end_film(self) -> Film | None:
        """Stop filming and return the film, None if there is none."""
        with self._lock:
            film, self._film = self._film, None
            return film

    def step(self) -> None:
        """Advance one control step, or begin again some time after an end."""
        with self._lock:
            episode = self._episode
            if self._ending and (self._steps_left == 0 or self._ending == "unstable"):
                if self.restarts:
                    self.reset()
                return
            episode.state.qvel[:2] += self._push
            self._push = np.zeros(2)
            command = self._command()
            ending = episode.step(command)
            self._feet.update(episode.state, episode.force)
            self._gates.append(self._policy.tensors()["gate"])
            self._take_picture()
            stands = self._is_stopped or abs(command[0]) < episode.body.config.reward.standing
            self._note = "" if stands and ending == "stalled" else NOTES.get(ending or "", "")
            if self._ending:
                self._steps_left -= 1
            elif ending in OVER:
                self._ending = ending

    @property
    def ending(self) -> str | None:
        """How the episode ended: a key of `OVER`, or None."""
        return self._ending

    @property
    def period(self) -> float:
        """Time between control steps, s."""
        return self._stage.body.config.physics.control_period

    def view(self) -> View:
        """Copy what there is to see."""
        with self._lock:
            episode, state = self._episode, self._episode.state
            turn = _heading(state.qpos)
            c, s = math.cos(turn), math.sin(turn)
            return View(
                stage=self._stage,
                episode=self._count,
                seconds=episode.steps * self.period,
                qpos=state.qpos.copy(),
                body_position=state.xpos.copy(),
                body_rotation=state.xquat.copy(),
                command=np.zeros(3) if self._is_stopped else episode.command.copy(),
                velocity=np.array([[c, s], [-s, c]]) @ state.qvel[:2],
                yaw_rate=float(state.qvel[5]),
                why=self._policy.why,
                note=OVER[self._ending] if self._ending else self._note,
                is_over=self._ending is not None,
                is_stopped=self._is_stopped,
                frame=episode.frame,
                attention=self._attention(),
                gates=np.array(self._gates),
                touchdowns=list(self._feet.touchdowns),
                soles=self._feet.centres,
                headings=self._feet.headings,
            )

    def _attention(self) -> Float[np.ndarray, " N"] | None:
        """Average the attention over the heads; None without any."""
        tensors = self._policy.tensors()
        weights = tensors.get("attention")
        if weights is None or not weights.any():
            return None
        return weights.reshape(-1, len(tensors["tokens"])).mean(axis=0)

    def _take_picture(self) -> None:
        film, episode = self._film, self._episode
        stride = max(1, round(1.0 / (RATE * self.period)))
        if film is None or film.stage is not self._stage or film.is_full or episode.steps % stride:
            return
        film.moments.append(
            Moment(
                self._count,
                episode.state.qpos.copy(),
                episode.frame,
                self._attention(),
                self._gates[-1],
            )
        )

    def _command(self) -> Float[np.ndarray, "3"]:
        """Compute the command of this step."""
        wish, episode = self.wish, self._episode
        assert wish.vx is not None
        if not wish.keep_lane:
            return np.array([wish.vx, wish.vy, wish.yaw_rate])
        c = self._stage.body.config.command
        return lane_command(c, wish.vx, episode.state.qpos) + np.array([0.0, wish.vy, 0.0])

    def _place_robot(self) -> None:
        stage = self._stage
        self._episode = Episode(stage.body, self._policy, stage.starts[self._number])
        self._feet = Feet(stage.body, self._episode.state)
        self._gates: collections.deque[np.ndarray] = collections.deque(
            [self._policy.tensors()["gate"]], maxlen=round(GATE_SECONDS / self.period)
        )
        self._push, self._note, self._ending = np.zeros(2), "", None
        self._is_stopped = False
        self._steps_left = round(RESTART_AFTER / self.period)
        self._count += 1


def _heading(qpos: Float[np.ndarray, " Q"]) -> float:
    """Compute where the base looks, rad to the left of x."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(qpos[3:7], float))
    return math.atan2(rotation[3], rotation[0])
