"""Pages may show pictures of ``results/``: they become part of the site, and links to them are made to fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

_RESULTS = Path(__file__).parents[1] / "results"


def on_files(files: Files, config: Any) -> Files:
    """Add every picture of a result to the site."""
    for picture in sorted(_RESULTS.rglob("*.png")):
        address = f"results/{picture.relative_to(_RESULTS).as_posix()}"
        files.append(File.generated(config, address, abs_src_path=str(picture)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """In the repository results/ lies beside docs/; in the site it lies inside."""
    return markdown.replace("](../results/", "](results/")
