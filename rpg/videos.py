"""Files of moving pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rpg.errors import RPGError


def video_writer(path: Path, fps: float) -> Any:
    """An imageio writer of an .mp4 or .gif; frames are uint8 (height, width, 3), for .mp4 of even size.

    Raises:
        RPGError: another ending.
    """
    import imageio.v2 as imageio  # starts the search for ffmpeg; not needed where no film is made

    if path.suffix == ".gif":
        return imageio.get_writer(path, duration=1000 / fps, loop=0)
    if path.suffix != ".mp4":
        raise RPGError(f"video {path}: choose a name that ends with .mp4 or .gif")
    return imageio.get_writer(path, fps=fps, codec="libx264", quality=7, macro_block_size=2)
