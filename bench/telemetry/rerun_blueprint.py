"""How a recording opens in Rerun: the layout that is stored in the file."""

from __future__ import annotations

import rerun.blueprint as rrb

TIMELINE = "bench_time"

_SKY = (203, 217, 230)


def blueprint() -> rrb.Blueprint:
    """Return the layout: the robot, the range, the figures of the shot, and signals around the cursor."""
    robot = rrb.Spatial3DView(
        name="Robot (trace: club head speed, blue 0 to red 50 m/s)",
        origin="/scene",
        contents=["/scene/**"],
        background=_SKY,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=(0.95, 1.15, 2.0),
            look_target=(0.0, 1.05, -0.6),
            eye_up=(0, 1, 0),
        ),
        overrides={"/scene/trace": _tail(1.1)},
    )
    flight = rrb.Spatial3DView(
        name="Flight",
        origin="/range",
        contents=["/range/**"],
        background=_SKY,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=(45, 55, 112), look_target=(116, 4, 0), eye_up=(0, 1, 0)
        ),
    )
    signals = rrb.Vertical(
        _series("Joint angle, ° (grey: reference)", True, "angle_deg/actual", "angle_deg/reference"),
        _series("Angle error (reference − actual), °", False, "angle_error_deg"),
        _series("Valve opening, −1 … 1", False, "valve/applied"),
        _series("Chamber pressure, bar absolute", False, "pressure_bar"),
        _series("Speed of club head and ball, m/s", True, "head_speed_mps", "ball_speed_mps"),
    )
    phases = rrb.StateTimelineView(
        name="Phase and reaction", origin="/signals", contents=["/signals/phase", "/signals/reaction"],
        time_view=rrb.TimeAxis(view_range=_around_cursor()), time_ranges=_range(),
    )  # fmt: skip
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Vertical(
                    robot,
                    rrb.Horizontal(
                        flight, rrb.TextDocumentView(name="Shot", origin="/shot"), column_shares=[1.75, 1]
                    ),
                    row_shares=[1.8, 1],
                ),
                signals,
                column_shares=[1.55, 1],
            ),
            phases,
            row_shares=[5, 1],
        ),
        rrb.TimePanel(
            state="collapsed", timeline=TIMELINE, playback_speed=0.25, play_state="playing", loop_mode="all"
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _series(name: str, legend: bool, *signals: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=name,
        origin="/signals",
        contents=[f"/signals/{signal}" for signal in signals],
        time_ranges=_range(),
        axis_x=rrb.TimeAxis(view_range=_around_cursor()),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
    )


def _around_cursor() -> rrb.TimeRange:
    """The part of the time axis that signals show: the swing around the cursor."""
    return rrb.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-1.6),
        end=rrb.TimeRangeBoundary.cursor_relative(seconds=1.2),
    )


def _range() -> rrb.VisibleTimeRange:
    return rrb.VisibleTimeRange(TIMELINE, _around_cursor())


def _tail(seconds: float) -> rrb.VisibleTimeRanges:
    """Show what was logged in the last `seconds` at once: a trace."""
    start, end = (rrb.TimeRangeBoundary.cursor_relative(seconds=s) for s in (-seconds, 0.0))
    return rrb.VisibleTimeRanges([rrb.VisibleTimeRange(TIMELINE, start=start, end=end)])
