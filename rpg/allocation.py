"""How the C library hands out memory to tensors on the CPU."""

from __future__ import annotations

import ctypes
import platform

# Parameters of mallopt(3).
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
_NEVER, _PAD = 2**31 - 1, 64 << 20


def keep_freed_memory() -> bool:
    """Keep memory of freed tensors in the process for the next ones, instead of returning it at once.

    Learning allocates and frees the same megabytes in every update. Left alone, glibc gives them back to the
    system and asks for them again, and each page of 4 kB is cleared and mapped anew.

    Returns:
        Whether this C library takes the settings; glibc alone does.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    settings = ((_MMAP_THRESHOLD, _NEVER), (_TRIM_THRESHOLD, _NEVER), (_TOP_PAD, _PAD))
    return all([mallopt(ctypes.c_int(name), ctypes.c_int(value)) == 1 for name, value in settings])
