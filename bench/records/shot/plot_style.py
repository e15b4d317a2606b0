"""Style of shot and swing pictures, and figures as reproducible inline SVG."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, get_font
from matplotlib.markers import MarkerStyle
from matplotlib.text import Text

from bench.base.atomic_file import atomic_file

COLOURS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00"),
    *("#8700F0", "#691E00", "#000F78", "#A5D278", "#783C69", "#2D0F1E"),
)
"""Okabe and Ito's six colours, and six more: no two come closer than the closest of the six, whether seen by
readers with or without a colour deficiency. Each ball also has its own marker."""
MARKERS = "os^DvpP<X>*h"
INK = "#1a1a1a"
GREY = "#6b7280"
_WIDTH = 7.4
"""Inches: the text width of a printed A4 page."""

STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": INK,
    "axes.edgecolor": "#9ca3af",
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e5e7eb",
    "grid.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "lines.linewidth": 1.2,
    "lines.solid_capstyle": "round",
    "svg.fonttype": "path",
    "path.simplify": True,
    "text.parse_math": False,  # names of balls are plain text, dollar signs included
}


def colour_of(index: int) -> str:
    """Return the colour of the level at `index`."""
    return COLOURS[index % len(COLOURS)]


def marker_of(index: int) -> str:
    """Return its marker; no two of 144 levels have both in common."""
    return MARKERS[(index + index // len(COLOURS)) % len(MARKERS)]


def marker_svg(index: int) -> str:
    """Return colour and marker of the level at `index` as an SVG element in the line of a text."""
    marker = MarkerStyle(marker_of(index))
    outlines = marker.get_path().transformed(marker.get_transform()).to_polygons(closed_only=False)
    shapes = " ".join(
        "M" + "L".join(f"{x:.2f} {-y:.2f}" for x, y in np.asarray(outline, dtype=float)) + "Z"
        for outline in outlines
    )
    return (
        '<svg class="swatch" viewBox="-.62 -.62 1.24 1.24" aria-hidden="true" focusable="false">'
        f'<path d="{shapes}" fill="{colour_of(index)}"/></svg>'
    )


def save_picture(figure: Figure, path: Path) -> None:
    """Write `figure` to `path`, whole or not at all; the suffix is the format.

    Raises:
        NotStored: the file cannot be written.
    """
    with atomic_file(path) as stream:
        figure.savefig(stream, format=path.suffix[1:].lower(), dpi=150)


def to_svg(figure: Figure, name: str) -> str:
    """Return `figure` as an SVG element for a page; `name` keeps its ids apart from other figures'."""
    stream = io.StringIO()
    # Glyphs that the font lacks are left to the reader's fonts.
    form = "none" if (foreign := _lacks_glyphs(figure)) else "path"
    with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": form}), warnings.catch_warnings():
        if foreign:
            warnings.filterwarnings("ignore", "Glyph .* missing from font")
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    svg = stream.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = re.sub(r'((?:xlink:)?href="|url\()#', rf"\1#{name}-", svg)
    return svg.replace("<svg ", '<svg aria-hidden="true" focusable="false" ', 1)


def _lacks_glyphs(figure: Figure) -> bool:
    """Return whether a text of `figure` has a character that the font of the style lacks."""
    known = get_font(findfont(STYLE["font.family"])).get_charmap()
    drawn = {character for text in figure.findobj(Text) for character in text.get_text()}
    return any(ord(character) not in known for character in drawn - {"\n"})


def styled(height: float) -> Figure:
    """Return an empty figure of the page's width and `height` (inches)."""
    return Figure(figsize=(_WIDTH, height), layout="constrained")
