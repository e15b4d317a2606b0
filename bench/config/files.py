"""Configuration files: finding them, laying them over each other, checking and building the configuration.

A file that begins with `base = "other.toml"` gives only the keys it changes. The base is a path from the
file's folder, the name of a variant that comes with golfbench, "shipped" for the configuration that comes
with golfbench, or "defaults" for the defaults of the code. A file without `base` must give every key. Keys
and units: `bench.from_toml`. Club and ball of the plant are those that `[swing]` names; an entry of `[clubs]`
or `[balls]` that says `like = "driver"` gives only what differs from that one.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from bench.config.club_site import ClubSite
from bench.config.defaults import DEFAULTS, DERIVED, default_tables
from bench.config.rules import RULES
from bench.config.settings import Configuration
from bench.errors import BenchError
from bench.from_toml import Builder, Leaf, Tree, as_tree, format_value, laid_over, place_of, read_toml

SHIPPED = "shipped"
VARIANTS = Path(__file__).parent.with_name("configurations")
"""Folder of the variants that come with golfbench; their names stand for their paths."""

_PRINT = "`golfbench check --defaults`"

_log = logging.getLogger("golfbench")


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
    if wanted.exists():
        return wanted
    if (named := _named(str(wanted))) is not None:
        return named
    expected = f"a configuration file, or one of {', '.join(_names())}"
    raise BenchError(str(wanted), "no such file", expected, "Correct the path.")


def _named(name: str) -> Path | None:
    """Return the file that comes with golfbench under `name`, or None."""
    if name == SHIPPED:
        return shipped_configuration()
    return VARIANTS / f"{name}.toml" if name in _names() else None


def _names() -> list[str]:
    return [SHIPPED, *sorted(path.stem for path in VARIANTS.glob("*.toml"))]


def variants_with(section: str, name: str) -> list[str]:
    """Return the variants that come with golfbench whose own file has the table [`section`.`name`]."""
    found = []
    for variant in sorted(VARIANTS.glob("*.toml")):
        table = read_toml(variant, "a configuration file", "Reinstall golfbench.").get(section)
        if isinstance(table, dict) and name in table:
            found.append(variant.stem)
    return found


def load_configuration(path: Path | None = None) -> Configuration:
    """Return the checked configuration at `path` (as `find_configuration` takes it).

    Raises:
        BenchError: a file is missing, cannot be read, or is not TOML.
        ExceptionGroup: of BenchErrors, one for each mistake in the files.
    """
    faults: list[BenchError] = []
    file = find_configuration(path)
    tree, files = _read(file, faults, ())
    for section in ("clubs", "balls"):
        _complete_likes(tree, section, file, faults)
    add = f'Add it; {_PRINT} prints every key. Or begin {_name(file)} with base = "{SHIPPED}".'
    cure = f"Correct the value; {_PRINT} prints its meaning, unit and default."
    builder = Builder(tree, file, cure, add, DERIVED, faults)
    configuration = builder.build(Configuration)
    if configuration is not None:
        configuration = _with_derived(configuration, files)
        for rule in RULES:
            for key, found, wanted, cure in rule(configuration, tree):
                faults.append(BenchError(place_of(tree, file, key), found, wanted, cure))
    if faults:
        # Entries that are like another one repeat its mistakes.
        once = {str(fault): fault for fault in faults}
        raise ExceptionGroup(f"{file} is not a valid configuration", list(once.values()))
    return configuration  # type: ignore[no-any-return]


def _read(file: Path, faults: list[BenchError], above: tuple[Path, ...]) -> tuple[Tree, tuple[Path, ...]]:
    """Return the tree of `file` over its base, and the files it comes from; `above` are those based on it."""
    file = _name(file)
    tables = read_toml(file, "a configuration file", "Correct the path.")
    base = tables.pop("base", None)
    tree = as_tree(tables, file, faults)
    if base is None:
        return tree, (file,)
    if base == DEFAULTS:
        return laid_over(as_tree(default_tables(), Path(DEFAULTS), faults), tree), (file,)
    expected = f'a path from this file\'s folder, "{DEFAULTS}", or one of {", ".join(_names())}'
    if not isinstance(base, str):
        raise BenchError(f"{file}: base", format_value(base), expected, "Correct it.")
    below = file.parent / base
    if base == SHIPPED or not below.exists():
        below = _named(base) or below
    if below.resolve() in [path.resolve() for path in (*above, file)]:
        expected = "a file that is not based on this one"
        raise BenchError(f"{file}: base", format_value(base), expected, "Name another base.")
    if not below.exists():
        found = f"{format_value(base)}, no such file"
        raise BenchError(f"{file}: base", found, expected, "Correct the path.")
    under, files = _read(below, faults, (*above, file))
    return laid_over(under, tree), (*files, file)


def _name(file: Path) -> Path:
    """Return `file` relative to the working directory when it lies in it; as it is when that is gone."""
    try:
        resolved, here = file.resolve(), Path.cwd()
    except FileNotFoundError:
        return file
    return resolved.relative_to(here) if resolved.is_relative_to(here) else file


def _complete_likes(tree: Tree, section: str, file: Path, faults: list[BenchError]) -> None:
    """Complete entries of `section` that say `like` with the values of the entry it names."""
    entries = tree.get(section)
    if not isinstance(entries, dict):
        return
    whole = {
        name: entry for name, entry in entries.items() if isinstance(entry, dict) and "like" not in entry
    }
    for name, entry in entries.items():
        if isinstance(entry, dict) and isinstance(like := entry.get("like"), Leaf):
            if isinstance(like.value, str) and like.value in whole:
                rest = {key: node for key, node in entry.items() if key != "like"}
                entries[name] = laid_over(whole[like.value], rest)
            else:
                known = f"one of {', '.join(whole)}, which say no like themselves"
                place = place_of(tree, file, f"{section}.{name}.like")
                faults.append(BenchError(place, format_value(like.value), known, "Name one of them."))
                entries[name] = {key: node for key, node in entry.items() if key != "like"}


def _with_derived(c: Configuration, files: tuple[Path, ...]) -> Configuration:
    """Return `c` with what follows from other keys: tick, club, site and ball of the plant.

    With `sites`, a club without one gets that of plant.site, so that changing clubs leads back to it.
    """
    if c.sites:
        c = replace(c, sites={name: ClubSite.of(c.plant) for name in c.clubs} | c.sites)
    club, ball = c.clubs.get(c.swing.club), c.balls.get(c.swing.ball)
    plant = c.plant if club is None else c.plant_of(c.swing.club, club)
    plant = replace(plant, tick=1.0 / c.loop.rate, ball=ball or c.plant.ball)
    return replace(c, plant=plant, files=files).with_driver(c.driver)
