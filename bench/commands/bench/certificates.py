"""`golfbench certificates` at the command line."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from bench.base.errors import BenchError
from bench.commands.common.options import argument, option


def certificates(
    folder: Annotated[Path, argument("DIR", "Folder of the certificates, created if absent.")],
    names: Annotated[list[str], argument("NAME...", "Names of people, benches and routers.")],
    addresses: Annotated[
        list[str] | None,
        option("IP address or host name where NAME listens; may be repeated.", "HOST", names="--address"),
    ] = None,
    days: Annotated[float, option("Days of validity.", low=0.01, high=3650.0)] = 365.0,
) -> None:
    """Make a certificate for each NAME, to reach the bench from other machines.

    The first call also makes the authority that signs them. Each side gets its NAME.pem and NAME.key and
    authority.pem; authority.key stays where it is. A bench or router needs --address. Ends with 1 when there
    is a certificate of that name.
    """
    from bench.config import NAME
    from bench.network.certificates import (
        AUTHORITY,
        make_authority,
        make_certificate,
        read_identity,
        write_identity,
    )

    for name in names:
        if not NAME.fullmatch(name) or name == AUTHORITY:
            expected = f"letters, digits, ., - and _, at most 63, and not {AUTHORITY}"
            raise BenchError("NAME", repr(name), expected, "Choose another name, e.g. bench1.")
    now = datetime.now(UTC)
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not (folder / f"{AUTHORITY}.pem").exists():
        write_identity(folder, AUTHORITY, make_authority(now))
        typer.echo(f"{folder / AUTHORITY}.pem: the authority")
    authority = read_identity(folder, AUTHORITY)
    for name in names:
        identity = make_certificate(authority, name, addresses or (), now, days)
        write_identity(folder, name, identity)
        until = identity.certificate.not_valid_after_utc
        typer.echo(f"{folder / name}.pem: valid until {until:%Y-%m-%d %H:%M} UTC")
