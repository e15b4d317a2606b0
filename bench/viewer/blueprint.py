"""Rerun layouts of recordings and live views, stored with the data."""

from __future__ import annotations

from typing import Any, NamedTuple

import rerun.blueprint as rrb
from rerun.blueprint.components import AbsoluteTimeRange

from bench.viewer._scene import TIMELINE
from sim.vectors import Vector

_SKY = (203, 217, 230)


class Span(NamedTuple):
    """A part of the recording, s of its time axis."""

    start: float
    end: float


class Window(NamedTuple):
    """Time range of the signals."""

    axis: rrb.TimeRange
    """Range of the axis when it is opened."""
    data: rrb.TimeRange
    """Range of the data that are drawn."""


def _around_cursor(before: float, after: float) -> Window:
    """Return the window from `before` (s) the cursor to `after` (s) it."""
    start, end = (rrb.TimeRangeBoundary.cursor_relative(seconds=s) for s in (-before, after))
    return Window(*[rrb.TimeRange(start=start, end=end)] * 2)


def _whole(span: Span) -> Window:
    """Return the window on `span`, from which the whole recording can be reached."""
    start, end = (rrb.TimeRangeBoundary.absolute(seconds=s) for s in span)
    all_data = rrb.TimeRange(start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite())
    return Window(rrb.TimeRange(start=start, end=end), all_data)


_SERIES = _around_cursor(8.0, 1.2)
"""The swing and the flight that follows it."""
_LIVE = _around_cursor(10.0, 0.0)
"""The last ten seconds."""
_ANGLES = ("angle_deg/actual", "angle_deg/reference", "angle_deg/golfer")
_SPEEDS = ("head_speed_mps", "golfer_head_speed_mps", "ball_speed_mps")
"""Signals of the plots in which a golfer appears, if there is one."""


def shot_blueprint(swing: Span, end: float) -> rrb.Blueprint:
    """Return the layout for one shot: the robot, its figures, and the signals of `swing`.

    It is played from the swing's start to `end` (s): a record begins seconds before, with the way to the
    address.
    """
    window = _whole(swing)
    return _of_records(
        window,
        rrb.Vertical(
            _robot(), rrb.Horizontal(_flight(), _figures(), column_shares=[1.75, 1]), row_shares=[1.8, 1]
        ),
        rrb.Vertical(
            *_joint_signals(window), _series(window, "Speed of club head and ball, m/s", True, *_SPEEDS)
        ),
        share=1.55,
        played=Span(swing.start, end),
    )


def campaign_blueprint() -> rrb.Blueprint:
    """Return the layout for several shots: all so far as dispersion and table, and the one at the cursor."""
    return _of_records(
        _SERIES,
        rrb.Vertical(
            rrb.Horizontal(_robot(), _dispersion(), column_shares=[1.1, 1]),
            rrb.Horizontal(_table(), _flight(), column_shares=[1.4, 1]),
            row_shares=[1.35, 1],
        ),
        rrb.Vertical(
            _figures(),
            _errors(_SERIES),
            _valves(_SERIES),
            _pressures(_SERIES),
            _series(_SERIES, "Speed of club head and ball, m/s", False, *_SPEEDS),
            row_shares=[1.5, 1, 1, 1, 1],
        ),
        share=2.1,
        speed=1.0,
    )


def live_blueprint() -> rrb.Blueprint:
    """Return the layout for a running bench with signals and loop timing."""
    signals = rrb.Vertical(
        *_joint_signals(_LIVE), _series(_LIVE, "Speed of club head, m/s", False, "head_speed_mps")
    )
    timing = rrb.Tabs(
        _series(_LIVE, "Tick timing, µs", True, "tick_us", "tick_us/limits"),
        rrb.BarChartView(
            name="Wake-up latency: log10 of ticks over µs (last bar: longer)",
            origin="/loop/wake_up_latency",
            plot_legend=rrb.PlotLegend(visible=False),
        ),
        active_tab=0,
    )
    events = rrb.TextLogView(
        name="Events", origin="/events", columns=rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
    )
    return _layout(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Vertical(
                    _robot(),
                    rrb.Horizontal(
                        rrb.TextDocumentView(name="Bench", origin="/bench"),
                        rrb.Tabs(_figures(), _table(), _dispersion(), _flight(), active_tab=0),
                        column_shares=[1, 1],
                    ),
                    row_shares=[1.3, 1],
                ),
                signals,
                column_shares=[1.3, 1],
            ),
            rrb.Horizontal(
                _states(_LIVE, "State, phase, reaction", "state", "phase", "reaction"),
                timing,
                events,
                column_shares=[1.6, 1.1, 1.1],
            ),
            row_shares=[3.4, 1],
        ),
        play_state="following",
    )


def _of_records(
    window: Window,
    left: rrb.Container,
    right: rrb.Container,
    share: float,
    speed: float = 0.25,
    played: Span | None = None,
) -> rrb.Blueprint:
    """Return a layout for playback of `played`, or of everything.

    `share` is the ratio of the left to the right width.
    """
    selection = None if played is None else AbsoluteTimeRange(*(round(1e9 * s) for s in played))
    return _layout(
        rrb.Vertical(
            rrb.Horizontal(left, right, column_shares=[share, 1]),
            _states(window, "Phase and reaction", "phase", "reaction"),
            row_shares=[5, 1],
        ),
        playback_speed=speed,
        play_state="playing",
        loop_mode="all" if selection is None else "selection",
        time_selection=selection,
    )


def _layout(content: rrb.Container, **playback: Any) -> rrb.Blueprint:
    """Return the layout of `content` with folded panels."""
    return rrb.Blueprint(
        content,
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, **playback),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


# Views -----------------------------------------------------------------------------------------------


def _robot() -> rrb.Spatial3DView:
    name = "Robot (trace: club head speed, blue 0 to red 50 m/s)"
    last = rrb.VisibleTimeRange(TIMELINE, _around_cursor(1.1, 0.0).data)
    trace = {"/scene/trace": rrb.VisibleTimeRanges([last])}
    return _outdoors(name, "/scene", (0.95, 1.15, 2.0), (0.0, 1.05, -0.6), overrides=trace)


def _flight() -> rrb.Spatial3DView:
    return _outdoors("Flight", "/range", (45.0, 55.0, 112.0), (116.0, 4.0, 0.0))


def _outdoors(name: str, origin: str, eye: Vector, target: Vector, **more: Any) -> rrb.Spatial3DView:
    """Return the view from `eye` to `target` (m) of all below `origin`."""
    controls = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital, position=eye, look_target=target, eye_up=(0, 1, 0)
    )
    return rrb.Spatial3DView(
        name=name,
        origin=origin,
        contents=[f"{origin}/**"],
        background=_SKY,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=controls,
        **more,
    )


def _dispersion() -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        name="Dispersion of carry (target up, ellipses two standard deviations)",
        origin="/dispersion",
        background=(14, 16, 20),
    )


def _figures() -> rrb.TextDocumentView:
    return rrb.TextDocumentView(name="Shot", origin="/shot")


def _table() -> rrb.TextDocumentView:
    return rrb.TextDocumentView(name="Shots", origin="/shots")


def _joint_signals(window: Window) -> list[rrb.View | rrb.Container]:
    efforts = rrb.Tabs(
        _series(window, "Effort of shoulder and wrist, N·m", False, "effort_nm", "effort_nm/limits"),
        _series(window, "Effort of right arm, N", False, "effort_n", "effort_n/limits"),
        active_tab=0,
    )
    angles = _series(window, "Joint angle, ° (grey: reference)", True, *_ANGLES)
    return [angles, _errors(window), efforts, _valves(window), _pressures(window)]


def _errors(window: Window) -> rrb.TimeSeriesView:
    return _series(window, "Angle error (reference − actual), °", False, "angle_error_deg")


def _valves(window: Window) -> rrb.TimeSeriesView:
    return _series(window, "Valve opening, −1 … 1", False, "valve/applied", "valve/measured", "valve/limits")


def _pressures(window: Window) -> rrb.TimeSeriesView:
    return _series(window, "Chamber pressure, bar absolute", False, "pressure_bar", "pressure_bar/limits")


def _states(window: Window, name: str, *codes: str) -> rrb.StateTimelineView:
    return rrb.StateTimelineView(
        name=name,
        origin="/signals",
        contents=[f"/signals/{code}" for code in codes],
        time_view=rrb.TimeAxis(view_range=window.axis),
        time_ranges=rrb.VisibleTimeRange(TIMELINE, window.data),
    )


def _series(window: Window, name: str, legend: bool, *signals: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=name,
        origin="/signals",
        contents=[f"/signals/{signal}" for signal in signals],
        time_ranges=rrb.VisibleTimeRange(TIMELINE, window.data),
        axis_x=rrb.TimeAxis(view_range=window.axis),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
    )
