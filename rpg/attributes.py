"""What environments say of themselves, through wrappers and out of worker processes."""

from __future__ import annotations

from typing import Any


def declared(envs: Any, name: str) -> Any:
    """The attribute ``name`` of a single or vector environment, or None if it has none.

    Looked for on the object itself, on what it wraps, and, for a vector environment that keeps single ones,
    on the first of them, in this process or in another.
    """
    layer = envs
    while layer is not None:
        # Not hasattr: a wrapper that forwards attributes would hide get_attr of the batch it wraps.
        if (own := getattr(layer, name, None)) is not None:
            return own
        if hasattr(type(layer), "get_attr"):
            try:
                return layer.get_attr(name)[0]
            except AttributeError:
                pass
        layer = getattr(layer, "env", None)
    return None
