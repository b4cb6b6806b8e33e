"""Writing of images and videos."""

import cref_jax.system.startup  # noqa: F401

import contextlib
import itertools
import subprocess
from collections.abc import Iterable
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from cref_jax.errors import ConfigError

Frame = UInt8[np.ndarray, "height width 3"]


def write_stills(out: Path, frames: Iterable[Frame]) -> None:
    """Write frames side by side as one image.

    Raises:
        ConfigError: the file cannot be written.
    """
    try:
        Image.fromarray(np.concatenate(list(frames), axis=1)).save(out)
    except OSError as error:
        raise ConfigError(f"cannot write {out}: {error.strerror or error}") from error


def write_video(out: Path, frames: Iterable[Frame], rate: float) -> None:
    """Write frames as an H.264 video of `rate` frames per second.

    Raises:
        ConfigError: ffmpeg fails.
    """
    part = out.with_suffix(".part.mp4")  # an interrupted video does not replace a complete one
    frames = iter(frames)
    first = next(frames)
    size = f"{first.shape[1]}x{first.shape[0]}"
    source = f"-f rawvideo -pix_fmt rgb24 -s {size} -r {rate:g} -i -"
    target = "-c:v libx264 -crf 20 -pix_fmt yuv420p -movflags faststart"
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y"]
    command = [*program, *source.split(), *target.split(), str(part)]
    try:
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
            assert ffmpeg.stdin and ffmpeg.stderr
            with contextlib.suppress(BrokenPipeError):  # ffmpeg reports the reason and exits
                for frame in itertools.chain([first], frames):
                    ffmpeg.stdin.write(frame.tobytes())
            message = ffmpeg.communicate()[1].decode(errors="replace").strip()
        if ffmpeg.returncode:
            reason = message.splitlines()[-1] if message else "ffmpeg"
            raise ConfigError(f"cannot write {out}: {reason}")
        part.replace(out)
    finally:
        part.unlink(missing_ok=True)
