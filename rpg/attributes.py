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
        if (own := getattr(layer, name, None)) is not None:
            return own
        # Asked first: a worker process that is asked for what it has not would end.
        if hasattr(type(layer), "get_attr") and layer.call("has_wrapper_attr", name)[0]:
            return layer.get_attr(name)[0]
        layer = getattr(layer, "env", None)
    return None
