"""Colours that readers with any colour vision can distinguish, and markers that need none."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
from numpy.typing import NDArray

from bench.records.shot.plot_style import COLOURS, MARKERS, STYLE, colour_of, marker_of, marker_svg, styled

Array = NDArray[np.float64]

VISION = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
"""Linear RGB as seen (Machado, Oliveira and Fernandes 2009, severity 1)."""
TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


def _lab(colour: str, vision: Array) -> Array:
    """Return CIELAB of a colour as seen."""
    value = np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)]) / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    xyz = TO_XYZ @ np.clip(vision @ linear, 0, 1) / [0.95047, 1, 1.08883]
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("vision", VISION)
def test_plot_colours_are_distinct_for_each_colour_vision(vision: str) -> None:
    seen = np.array([_lab(colour, VISION[vision]) for colour in COLOURS])
    apart = np.linalg.norm(seen[:, None] - seen, axis=-1)[np.triu_indices(len(seen), 1)]
    assert apart.min() > 16.0  # CIELAB; just noticeable is 2.3
    assert seen[:, 0].max() < 82  # not lost on white


def test_plot_style_levels_have_unique_colour_and_marker() -> None:
    assert len(set(COLOURS)) == len(COLOURS) == len(set(MARKERS)) == len(MARKERS) == 12
    assert len({(colour_of(n), marker_of(n)) for n in range(144)}) == 144


def test_marker_svg_matches_plot_marker_and_colour() -> None:
    marks = {marker_svg(n) for n in range(12)}
    assert len(marks) == 12
    assert all("nan" not in mark and mark.count("<path") == 1 for mark in marks)
    assert colour_of(3) in marker_svg(3)


def test_plot_style_nearly_equal_values_show_no_axis_offset() -> None:
    with mpl.rc_context(STYLE):
        figure = styled(1.0)
        axes = figure.subplots()
        axes.plot([43.20001, 43.20004], [101325.01, 101325.02])
        figure.draw_without_rendering()
    assert axes.xaxis.get_offset_text().get_text() == ""
    assert axes.yaxis.get_offset_text().get_text() == ""
    assert all(label.get_text().startswith("43.2") for label in axes.get_xticklabels())
