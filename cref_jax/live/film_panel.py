"""A button that films what the robot does, and the file that comes of it."""

import datetime
from collections.abc import Callable
from pathlib import Path

import viser

from cref_jax.errors import ConfigError
from cref_jax.live import film
from cref_jax.live.session import Session


class FilmPanel:
    """Films into the folder that the program was started in, and to the viewer who asked."""

    def __init__(
        self, server: viser.ViserServer, session: Session, complain: Callable[[str], None]
    ) -> None:
        self._server, self._session, self._complain = server, session, complain
        with server.gui.add_folder("Film"):
            self._button = server.gui.add_button(
                "Film", hint=f"simulated time, {film.MOST_SECONDS:g} s at most"
            )
            self._said = server.gui.add_markdown("", visible=False)
        self._button.on_click(self._toggle)

    def _toggle(self, event: viser.GuiEvent) -> None:
        taken = self._session.end_film()
        if taken is None:
            self._session.start_film()
            self._button.label = "End the film"
            return
        self._button.label = "Film"
        if taken.moments:
            self._write(taken, event.client)

    def _write(self, taken: film.Film, viewer: viser.ClientHandle | None) -> None:
        """Write the film, and say so meanwhile."""
        out = Path(f"live-{datetime.datetime.now():%Y%m%d-%H%M%S}.mp4")
        self._button.disabled, self._said.visible = True, True
        self._said.content = f"*drawing {len(taken.moments) / film.RATE:.0f} s …*"
        try:
            film.write_film(out, taken)
            self._said.content = f"wrote {out}"
            if viewer and viewer.client_id in self._server.get_clients():  # may have left
                viewer.send_file_download(out.name, out.read_bytes())
        except (ConfigError, OSError) as error:
            self._said.visible = False
            self._complain(str(error))
        finally:
            self._button.disabled = False
