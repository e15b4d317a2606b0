"""`golfbench schema`: the wire contract, without a running bench."""

from __future__ import annotations

import typer

from bench.commands.common.session import Session, show_json


def schema(context: typer.Context) -> None:
    """Print the messages of a bench for other programs: keys, JSON Schemas, columns, units; as JSON.

    A running bench answers the same on golfbench/BENCH/schema.
    """
    from bench.network.messages import wire_contract

    bench = context.ensure_object(Session).configuration().bench.id
    show_json(wire_contract(bench))
