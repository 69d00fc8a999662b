"""Drawing without a screen."""

from __future__ import annotations

import ctypes.util
import logging
import os
import sys
from functools import cache
from pathlib import Path


@cache
def prefer_offscreen_gl() -> None:
    """Have MuJoCo draw off screen where there is none: by EGL beside an NVIDIA driver, else by OSMesa.

    MuJoCo reads ``MUJOCO_GL`` when it is first imported, so this comes before. A value that is set is kept, and so
    is MuJoCo's own choice where neither library is there: only pictures would fail then.
    """
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    logging.getLogger("OpenGL").setLevel(
        logging.WARNING
    )  # it tells of every accelerator that is not installed
    if sys.platform != "linux" or screen or "MUJOCO_GL" in os.environ:
        return
    if Path("/dev/nvidiactl").exists() and ctypes.util.find_library("EGL"):
        os.environ["MUJOCO_GL"] = "egl"
    elif ctypes.util.find_library("OSMesa"):
        os.environ["MUJOCO_GL"] = "osmesa"
