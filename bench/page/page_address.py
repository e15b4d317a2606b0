"""Where the page is reached, and by whom."""

from __future__ import annotations

from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from bench.address import identity_files
from bench.errors import BenchError, Refused
from bench.page.page_access import PageAccess, PageRole, read_tokens

if TYPE_CHECKING:
    from bench.config import Configuration

PORT = 8600
"""Port of the page unless another one is given."""


class PageAddress(NamedTuple):
    """Where the page is reached, and by whom."""

    host: str = "127.0.0.1"
    """IP address to listen at."""
    port: int = PORT
    identity: str = ""
    """Path, without ending, of certificate and key; empty: no TLS, on the loopback only."""
    tokens: Path | None = None
    """File of tokens; None: none."""

    @property
    def scheme(self) -> str:
        """Scheme of the page's URL."""
        return "https" if self.identity else "http"


def checked_address(address: PageAddress) -> tuple[str, ...]:
    """Return HOST:PORT of all names under which the page is reached.

    Raises:
        BenchError: the host is no IP address; the certificate or its key is invalid.
        Refused: beyond the loopback without TLS.
    """
    try:
        ip = ip_address(address.host)
    except ValueError:
        expected = "an IP address of this machine, or 0.0.0.0 for all"
        raise BenchError(
            "--host",
            repr(address.host),
            expected,
            "Give --host 127.0.0.1 or another address of this machine.",
        ) from None
    if not ip.is_loopback and not address.identity:
        expected = "a certificate for this machine: commands and tokens must not be readable on the network"
        cure = "Make one: golfbench certificates DIR NAME --address HOST, then add --identity DIR/NAME."
        raise Refused(f"--host {address.host}", "an address for other machines without TLS", expected, cure)
    names = {"127.0.0.1", "localhost", "[::1]"} if ip.is_loopback else set[str]()
    if not ip.is_unspecified:
        names.add(f"[{ip}]" if ip.version == 6 else str(ip))
    if address.identity:
        names |= _certified_names(identity_files(address.identity).certificate)
    default = 443 if address.identity else 80
    return tuple(
        sorted({f"{n}:{address.port}" for n in names} | (names if address.port == default else set()))
    )


def _certified_names(file: Path) -> set[str]:
    """Return host names and addresses in the certificate `file`, as a URL has them."""
    from cryptography import x509

    certificate = x509.load_pem_x509_certificate(file.read_bytes())
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        cure = "Make one with golfbench certificates DIR NAME --address HOST."
        raise BenchError(str(file), "a client's certificate", "one with addresses", cure) from None
    addresses = found.get_values_for_type(x509.IPAddress)
    return set(found.get_values_for_type(x509.DNSName)) | {
        f"[{ip}]" if ip.version == 6 else str(ip) for ip in addresses
    }


def page_access(address: PageAddress, configuration: Configuration) -> PageAccess:
    """Return who may do what at `address`; raises as `read_tokens`."""
    tokens: dict[str, PageRole] = read_tokens(address.tokens) if address.tokens else {}
    network = configuration.network
    return PageAccess(network.viewers, network.operators, tokens, closed=bool(address.identity))
