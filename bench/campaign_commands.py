"""`golfbench campaign ...`: plan, run, judge and keep test series."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.session import Session

if TYPE_CHECKING:
    from bench.campaign.plan import Plan
    from bench.config import Configuration

app = typer.Typer(help="Test series: plan, run, judge and keep them.", no_args_is_help=True)

File = Annotated[
    Path, typer.Argument(metavar="FILE", help="A plan, TOML, or the name of one that comes with golfbench.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for a program to read.")]


@app.command()
def check(
    context: typer.Context,
    file: File,
    everything: Annotated[bool, typer.Option("--all", help="Print every block.")] = False,
    json_: Json = False,
) -> None:
    """Check a plan and print its order and what it can resolve, before anything moves.

    Ends with 2 and every mistake found.
    """
    import json

    from rich.console import Console

    from bench.campaign.preview import preview_record, show_preview

    plan, _ = _checked(context, file)
    if json_:
        typer.echo(json.dumps(preview_record(plan), indent=2))
    else:
        show_preview(plan, Console(), everything=everything)


def _checked(context: typer.Context, file: Path) -> tuple[Plan, Configuration]:
    """Return the plan in `file`, whose swings fit its clubs, and the configuration."""
    from bench.campaign.plan import load_plan
    from bench.campaign.swings import require_swings

    configuration = context.ensure_object(Session).configuration()
    plan = load_plan(file, configuration)
    require_swings(plan, configuration)
    return plan, configuration
