"""Option for a picture beside what a command prints."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.errors import BenchError

Plot = Annotated[Path | None, typer.Option(metavar="FILE", help="Also plot it: .png, .svg or .pdf.")]


def require_picture(plot: Path | None) -> None:
    """Raise BenchError unless the suffix of `plot` is that of a picture."""
    if plot is not None and plot.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise BenchError("--plot", str(plot), "a name that ends in .png, .svg or .pdf", "Change its ending.")
