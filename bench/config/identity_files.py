"""Files of a side's certificate, as `golfbench certificates` writes them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from bench.errors import BenchError


class IdentityFiles(NamedTuple):
    """Certificate and key of one side, and the authority that signs all, PEM."""

    authority: Path
    certificate: Path
    key: Path


def identity_files(identity: str) -> IdentityFiles:
    """Return the files of `identity`, a path without ending.

    Raises:
        BenchError: a file is missing, no PEM, or of another certificate.
    """
    import ssl

    files = IdentityFiles(
        Path(identity).with_name("authority.pem"), Path(f"{identity}.pem"), Path(f"{identity}.key")
    )
    # zenoh would say no more than that it cannot connect.
    context, file = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), files.authority
    try:
        context.load_verify_locations(files.authority)
        file = files.certificate
        context.load_cert_chain(files.certificate, files.key, password=lambda: b"")
    except (OSError, ValueError) as error:
        raise BenchError(
            f"network.identity {identity}",
            f"{file}: {error.strerror if isinstance(error, OSError) else error}",
            f"{files.certificate.name}, {files.key.name} that fits it, and {files.authority.name}, PEM, "
            "in one folder",
            "Correct the path, or make them: golfbench certificates.",
        ) from None
    return files
