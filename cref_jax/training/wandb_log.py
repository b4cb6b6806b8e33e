"""The log of a run at Weights & Biases; no error there stops a run."""

import importlib
import netrc
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from cref_jax.errors import ConfigError

PROJECT = "cref_jax"
ID = "wandb_id"  # file in the run's folder
HOST = "api.wandb.ai"  # a key for it counts for the host that took its place, too


def check_installed() -> None:
    """Check that the package is there, before anything is written.

    Raises:
        ConfigError: it is not.
    """
    try:
        importlib.import_module("wandb")
    except ModuleNotFoundError as error:
        if error.name == "wandb":
            raise ConfigError(
                "--wandb needs the package wandb; install it with: pip install 'cref-jax[wandb]'"
            ) from None
    except Exception:  # a broken installation is said by the first call, as any other error
        pass


class WandbLog:
    """Writes every iteration to one run at W&B: after the first error, nothing, with a warning."""

    def __init__(self, run: Path, config: Mapping[str, Any], say: Callable[[str], None]) -> None:
        """Begin the run, or go on with the one whose id is in the folder; `say` prints a line."""
        self._say = say
        self._run: Any = None
        self._attempt(lambda: self._begin(run, config))

    def log(self, row: Mapping[str, float], iteration: int) -> None:
        """Write the values of an iteration."""
        if self._run is not None:
            self._attempt(lambda: self._run.log(dict(row), step=iteration))

    def close(self) -> None:
        """End the run."""
        if self._run is not None:
            self._attempt(lambda: self._run.finish())
            self._run = None

    def _attempt(self, act: Callable[[], Any]) -> None:
        try:
            act()
        except Exception as error:  # whatever it is: training is worth more than its log
            self._run = None
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            self._say(f"warning: no more is logged to wandb: {reason}")

    def _begin(self, run: Path, config: Mapping[str, Any]) -> None:
        wandb: Any = importlib.import_module("wandb")
        stored, settings = run / ID, wandb.Settings(console="off", silent=True)
        mode = choose_mode(settings.base_url)
        begun = wandb.init(
            project=os.environ.get("WANDB_PROJECT", PROJECT),
            name=run.name,
            id=stored.read_text().strip() if stored.exists() else None,
            resume="allow",
            dir=str(run),
            config=dict(config),
            mode=mode,
            settings=settings,
        )
        stored.write_text(f"{begun.id}\n")
        self._run = begun
        if mode == "offline":
            self._say(f"wandb: offline, in {run / 'wandb'}; `wandb sync` sends it")
        else:
            self._say(f"wandb: {begun.url}")


def choose_mode(url: str) -> str:
    """Choose the mode: WANDB_MODE, else online where there is a key for `url`, else offline.

    `wandb login` leaves keys in the file .netrc; WANDB_API_KEY may hold one.
    """
    given = os.environ.get("WANDB_MODE")
    if given or os.environ.get("WANDB_API_KEY"):
        return given or "online"
    try:
        known = netrc.netrc(os.environ.get("NETRC"))
    except (OSError, netrc.NetrcParseError):
        return "offline"
    hosts = (urlsplit(url).hostname or HOST, HOST)
    return "online" if any(known.authenticators(host) for host in hosts) else "offline"
