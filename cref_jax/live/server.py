"""The web server of the page, on this machine alone."""

import contextlib
import io
import os
import socket
import sys
import webbrowser
from dataclasses import dataclass
from pathlib import Path

import viser

from cref_jax.errors import ConfigError
from cref_jax.live import policies
from cref_jax.live.page import Page
from cref_jax.live.session import Session, Wish
from cref_jax.live.stage import Place, StageBuilder
from cref_jax.policy import sources

PORTS = 20  # that are tried, from the one asked for


@dataclass(frozen=True)
class Settings:
    """What the page begins with."""

    policy: Path
    place: Place
    seed: int = 0
    speed: float | None = None  # m/s forward
    host: str = "127.0.0.1"
    port: int = 8080
    opens_browser: bool = False


def serve(settings: Settings) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        ConfigError: policy, ground, host or port cannot be used.
    """
    port = find_port(settings.host, settings.port)
    page = open_page(settings, port)
    print(describe_address(settings.host, port), flush=True)
    if settings.opens_browser and _has_desktop():
        webbrowser.open(f"http://{settings.host}:{port}")
    page.run()


def open_page(settings: Settings, port: int) -> Page:
    """Load policy and ground, and listen."""
    builder = StageBuilder(settings.seed)
    session = Session(builder.build(policies.load(settings.policy), settings.place))
    session.drive(Wish(vx=settings.speed))
    with contextlib.redirect_stdout(io.StringIO()):  # it would print a table of its own
        server = viser.ViserServer(settings.host, port, label="cref_jax", verbose=False)
    run = settings.policy if sources.is_run(sources.find_policy(settings.policy)) else None
    return Page(server, session, builder, run)


def _has_desktop() -> bool:
    """Check whether a browser would have a window; without one a text browser may open instead."""
    return sys.platform != "linux" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys())


def find_port(host: str, port: int) -> int:
    """Find the first free port from `port` on.

    Raises:
        ConfigError: there is none, or the host is not one of this machine.
    """
    for number in range(port, min(port + PORTS, 65536)):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, number))
                return number
            except socket.gaierror as error:
                raise ConfigError(f"--host {host}: {error.strerror}") from None
            except PermissionError:
                raise ConfigError(f"port {number} needs rights that you lack; take 8080") from None
            except OSError as error:
                if error.errno != socket.errno.EADDRINUSE:  # pyright: ignore
                    raise ConfigError(f"--host {host}: {error.strerror}") from None
    raise ConfigError(f"ports {port} to {number} are taken; give another --port")


def describe_address(host: str, port: int) -> str:
    """Say where the page is, also from another machine."""
    return (
        f"open http://{host}:{port}\n"
        f"from another machine: ssh -L {port}:{host}:{port} {socket.gethostname()}, then the same\n"
        "Ctrl-C ends it"
    )
