"""Name and addresses of a bench: the same as in the whole configuration, and nothing else is read."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.base.address import load_address
from bench.base.errors import BenchError
from bench.config import VARIANTS, load_configuration


@pytest.mark.parametrize("name", ["shipped", *sorted(path.stem for path in VARIANTS.glob("*.toml"))])
def test_load_address_variant_matches_load_configuration(name: str) -> None:
    whole, address = load_configuration(Path(name)), load_address(Path(name))
    assert (address.bench, address.network) == (whole.bench, whole.network)


def test_load_address_base_defaults_uses_code_defaults(tmp_path: Path) -> None:
    file = tmp_path / "bench.toml"
    file.write_text(
        'base = "defaults"\n[bench]\nid = "b"\ndata_dir = "d"\n[network]\nendpoint = "tcp/127.0.0.1:7000"\n'
    )
    address = load_address(file)
    assert (address.bench.id, address.bench.database) == ("b", "")
    assert (address.network.endpoint, address.network.operators) == ("tcp/127.0.0.1:7000", ())


def test_load_address_mistake_in_other_section_is_ignored(tmp_path: Path) -> None:
    """A robot is stopped with any configuration whose bench can be reached."""
    file = tmp_path / "bench.toml"
    file.write_text('base = "shipped"\n[loop]\nrate_hz = -3.0\n[no_such_section]\nx = 1\n')
    assert load_address(file).bench.id == "bench1"
    with pytest.raises(ExceptionGroup):
        load_configuration(file)


@pytest.mark.parametrize(
    ("text", "location"),
    [
        ('[bench]\nid = "a b"', "bench.id"),
        ("[bench]\nid = 3", "bench.id"),
        ('[network]\nendpoint = "tcp/10.0.0.1:7451"', "network.endpoint"),
        ('[network]\nendpont = "tcp/127.0.0.1:7451"', "network.endpont"),
        ('[network]\nendpoint = "tls/host:7451"', "network.identity"),
    ],
)
def test_load_address_mistake_is_refused_with_location(tmp_path: Path, text: str, location: str) -> None:
    file = tmp_path / "bench.toml"
    file.write_text(f'base = "shipped"\n{text}\n')
    with pytest.raises(ExceptionGroup) as caught:
        load_address(file)
    (fault,) = caught.value.exceptions
    assert isinstance(fault, BenchError)
    assert location in fault.location
