"""Certificates for a bench that is reached from other machines: one authority, one certificate a name.

The name in a certificate is what `network.viewers` and `network.operators` list. Keys are of NIST curve
P-256 and readable by their owner only.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from datetime import datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from bench.base.errors import BenchError, ExitCode, Refused

AUTHORITY = "authority"
AUTHORITY_DAYS = 3650.0
"""d, validity of the authority."""

_SLACK = timedelta(minutes=5)
"""Tolerated difference between the clocks of two machines."""


class Identity(NamedTuple):
    """A certificate and the key that proves it."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def make_authority(now: datetime) -> Identity:
    """Return a new authority, valid for AUTHORITY_DAYS from `now` (with its time zone)."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name("golfbench authority")
    certificate = (
        _begin(name, name, key, now, AUTHORITY_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    return Identity(certificate, key)


def make_certificate(
    authority: Identity, name: str, addresses: Sequence[str], now: datetime, days: float
) -> Identity:
    """Return a certificate for `name`, signed by `authority`, valid for `days` from `now`.

    `addresses`: the IP addresses and host names at which it listens; without any it is a client's only.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH] + [ExtendedKeyUsageOID.SERVER_AUTH] * bool(addresses)
    issuer = authority.certificate
    builder = (
        _begin(_name(name), issuer.subject, key, now, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()), critical=False
        )
    )
    if addresses:
        names = [_address(address) for address in addresses]
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    return Identity(builder.sign(authority.key, hashes.SHA256()), key)


def write_identity(folder: Path, name: str, identity: Identity) -> None:
    """Write `NAME.key` (mode 600) and `NAME.pem` into `folder`.

    Raises:
        Refused: there is one already; it is not touched.
        OSError: the folder cannot be written to.
    """
    key = identity.key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    certificate = identity.certificate.public_bytes(serialization.Encoding.PEM)
    for ending, content, mode in (("key", key, 0o600), ("pem", certificate, 0o644)):
        path = folder / f"{name}.{ending}"
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        except FileExistsError:
            action = "Delete both files to make a new one; the old one stays valid until it expires."
            raise Refused(str(path), "there already", "a name without a certificate", action) from None
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(content)


def read_identity(folder: Path, name: str) -> Identity:
    """Return the identity that `write_identity` wrote.

    Raises:
        BenchError: it is missing or of another kind.
    """
    path = folder / f"{name}.pem"
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
        path = folder / f"{name}.key"
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except OSError as error:
        found, action = error.strerror or str(error), f"Restore {path} from a backup."
        raise BenchError(str(path), found, "a readable file", action, code=ExitCode.FILE) from None
    except (ValueError, TypeError) as error:
        action = f"Restore {path} from a backup."
        raise BenchError(str(path), str(error), "a certificate or key, PEM", action) from None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise BenchError(str(path), "another key", f"the key of {name}.pem", f"Restore {path} from a backup.")
    return Identity(certificate, key)


def _begin(
    name: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, now: datetime, days: float
) -> x509.CertificateBuilder:
    public = key.public_key()
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _SLACK)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
    )


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _address(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(text))
    except ValueError:
        return x509.DNSName(text)
