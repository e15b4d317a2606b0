"""Certificates: the command's files, and rejection of all others."""

from __future__ import annotations

import stat
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from bench.base.errors import BenchError, ExitCode, Refused
from bench.network.certificates import AUTHORITY, make_authority, read_identity, write_identity
from tests.conftest import Run


def load(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


def test_certificates_command_creates_bench_and_client_identities(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "certificates"
    assert (
        run("certificates", folder, "bench1", "--address", "192.0.2.5", "--address", "bench.example")[0] == 0
    )
    assert run("certificates", folder, "anna", "bob", "--days", "30")[0] == 0
    names = {f"{name}.{end}" for name in (AUTHORITY, "bench1", "anna", "bob") for end in ("pem", "key")}
    assert {path.name for path in folder.iterdir()} == names
    for path in folder.glob("*.key"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    authority = load(folder / "authority.pem")
    for name, days, addresses in (("bench1", 365, 2), ("anna", 30, 0)):
        certificate = load(folder / f"{name}.pem")
        certificate.verify_directly_issued_by(authority)
        (common,) = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        assert common.value == name
        left = certificate.not_valid_after_utc - datetime.now(UTC)
        assert timedelta(days - 1) < left < timedelta(days)
        purposes = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert (ExtendedKeyUsageOID.SERVER_AUTH in purposes) == bool(addresses)
        assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    listens = load(folder / "bench1.pem").extensions.get_extension_for_class(x509.SubjectAlternativeName)
    assert listens.value.get_values_for_type(x509.IPAddress) == [ip_address("192.0.2.5")]
    assert listens.value.get_values_for_type(x509.DNSName) == ["bench.example"]


def test_certificates_command_existing_name_is_refused_unchanged(run: Run, tmp_path: Path) -> None:
    run("certificates", tmp_path, "anna")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    refused = run("certificates", tmp_path, "anna")
    assert (refused.code, "anna.key" in refused.words) == (ExitCode.REFUSED, True)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("name", ["", "../anna", "an na", AUTHORITY, "-x", "a" * 64])
def test_certificates_command_invalid_name_is_rejected(name: str, run: Run, tmp_path: Path) -> None:
    assert run("certificates", tmp_path / "new", "--", name).code == ExitCode.BAD_INPUT
    assert not (tmp_path / "new").exists()


def test_certificates_command_unusable_folder_exits_with_file_error(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    outcome = run("certificates", tmp_path / "file", "anna")
    assert outcome.code == ExitCode.FILE, outcome.words


def test_certificates_command_invalid_authority_is_rejected(run: Run, tmp_path: Path) -> None:
    run("certificates", tmp_path, "anna")
    (tmp_path / "authority.key").write_bytes((tmp_path / "anna.key").read_bytes())
    assert run("certificates", tmp_path, "bob")[0] == ExitCode.BAD_INPUT
    (tmp_path / "authority.key").write_text("no key")
    assert run("certificates", tmp_path, "bob")[0] == ExitCode.BAD_INPUT
    (tmp_path / "authority.key").unlink()
    assert run("certificates", tmp_path, "bob")[0] == ExitCode.FILE
    assert not (tmp_path / "bob.pem").exists()


def test_read_identity_restores_written_identity(tmp_path: Path) -> None:
    made = make_authority(datetime.now(UTC))
    write_identity(tmp_path, "x", made)
    read = read_identity(tmp_path, "x")
    assert read.certificate == made.certificate
    assert read.key.private_numbers() == made.key.private_numbers()
    with pytest.raises(Refused):
        write_identity(tmp_path, "x", made)
    with pytest.raises(BenchError):
        read_identity(tmp_path, "y")
