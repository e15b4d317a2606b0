"""Configuration files: how they are found, and merged by precedence.

A file that begins with `base = "other.toml"` gives only the keys it changes. The base is a path from the
file's folder, the name of a variant that comes with golfbench, "shipped" for the configuration that comes
with golfbench, or "defaults" for the defaults of the code. A file without `base` must give every key.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bench.base.errors import BenchError, did_you_mean
from bench.base.from_toml import Tree, as_tree, format_value, laid_over, read_toml

SHIPPED = "shipped"
"""Base of a file that is laid over the configuration that comes with golfbench."""
DEFAULTS = "defaults"
"""Base of a file that is laid over the defaults of the code."""
VARIANTS = Path(__file__).parents[1] / "configurations"
"""Folder of the variants that come with golfbench; their names stand for their paths."""
PRINT = "`golfbench check --defaults`"
"""The command that prints every key."""


def shipped_configuration() -> Path:
    """Return the path of the configuration that comes with golfbench."""
    package = Path(__file__).parents[1]
    installed = package / "config.toml"
    return installed if installed.exists() else package.parent / "config.toml"


def find_configuration(wanted: Path | None = None) -> Path:
    """Return the file for `wanted`: a path or the name of a variant.

    Without it: `config.toml` in the working directory, else the shipped one.

    Raises:
        BenchError: no file has that path or name.
    """
    if wanted is None:
        here = Path("config.toml")
        return here if here.exists() else shipped_configuration()
    if wanted.exists() and not wanted.is_dir():
        return wanted
    if (named := _named(str(wanted))) is not None:
        return named
    found = "a folder, or an empty text" if wanted.is_dir() else "no such file"
    expected = f"a configuration file, or one of {', '.join(variant_names())}"
    action = did_you_mean(wanted.name, variant_names(), "Correct the path after --config.")
    raise BenchError(f"--config {wanted}", found, expected, action)


def _named(name: str) -> Path | None:
    """Return the file that comes with golfbench under `name`, or None."""
    if name == SHIPPED:
        return shipped_configuration()
    return VARIANTS / f"{name}.toml" if name in variant_names() else None


def variant_names() -> list[str]:
    """Return the names that stand for configurations that come with golfbench."""
    return [SHIPPED, *sorted(path.stem for path in VARIANTS.glob("*.toml"))]


def variants_with(section: str, name: str) -> list[str]:
    """Return the variants that come with golfbench whose own file has the table [`section`.`name`]."""
    found = []
    for variant in sorted(VARIANTS.glob("*.toml")):
        table = read_toml(variant, "a configuration file", "Reinstall golfbench.").get(section)
        if isinstance(table, dict) and name in table:
            found.append(variant.stem)
    return found


def read_layers(
    file: Path,
    defaults: Callable[[], Mapping[str, Any]],
    faults: list[BenchError],
    above: tuple[Path, ...] = (),
) -> tuple[Tree, tuple[Path, ...]]:
    """Return the tree of `file` over its base, and the files it comes from, the base first.

    `defaults` returns the tables of base "defaults"; `above` are the files that are based on this one.

    Raises:
        BenchError: a file is missing, cannot be read, or is not TOML; a base is unusable or based on itself.
    """
    file = shown_path(file)
    tables = read_toml(file, "a configuration file", "Correct the path.")
    base = tables.pop("base", None)
    tree = as_tree(tables, file, faults)
    if base is None:
        return tree, (file,)
    if base == DEFAULTS:
        return laid_over(as_tree(defaults(), Path(DEFAULTS), faults), tree), (file,)
    expected = f'a path from this file\'s folder, "{DEFAULTS}", or one of {", ".join(variant_names())}'
    if not isinstance(base, str):
        raise BenchError(
            f"{file}: base", format_value(base), expected, 'Write base = "shipped", or a path in quotes.'
        )
    below = file.parent / base
    if base == SHIPPED or not below.exists():
        below = _named(base) or below
    if below.resolve() in [path.resolve() for path in (*above, file)]:
        expected = "a file that is not based on this one"
        raise BenchError(
            f"{file}: base", format_value(base), expected, 'Write base = "shipped" in one of the files.'
        )
    if not below.exists():
        found = f"{format_value(base)}, no such file"
        raise BenchError(f"{file}: base", found, expected, "Correct the path in the key base.")
    under, files = read_layers(below, defaults, faults, (*above, file))
    return laid_over(under, tree), (*files, file)


def shown_path(file: Path) -> Path:
    """Return `file` relative to the working directory when it lies in it; as it is when that is gone."""
    try:
        resolved, here = file.resolve(), Path.cwd()
    except FileNotFoundError:
        return file
    return resolved.relative_to(here) if resolved.is_relative_to(here) else file
