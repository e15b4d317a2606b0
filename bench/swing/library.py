"""The profiles that come with golfbench, by name; any other one by its path."""

from __future__ import annotations

from pathlib import Path

from bench.base.errors import BenchError, did_you_mean
from bench.base.from_toml import parse_toml

PROFILES = Path(__file__).with_name("profiles")


def profile_names() -> list[str]:
    """Return the names of the profiles that come with golfbench."""
    return sorted(path.stem for path in PROFILES.glob("*.toml") if "." not in path.stem)


def profiles_for(club: str) -> list[str]:
    """Return the names of the profiles that come with golfbench for `club`."""
    files = {name: PROFILES / f"{name}.toml" for name in profile_names()}
    return [name for name, file in files.items() if parse_toml(file.read_text("utf-8"), name)["club"] == club]


def find_profile(name_or_path: str | Path) -> Path:
    """Return the file of a profile: one that comes with golfbench, by name, or any other by its path.

    Raises:
        BenchError: no profile has that name or path; the text lists the known ones.
    """
    wanted = Path(name_or_path)
    if len(wanted.parts) == 1 and wanted.name in profile_names():
        return PROFILES / f"{wanted.name}.toml"
    if wanted.is_file():
        return wanted
    names = profile_names()
    known = f"a path, or one of {', '.join(names)}" if names else "a path"
    action = did_you_mean(
        wanted.name.removesuffix(".toml"), names, "`golfbench profile list` shows the known ones."
    )
    raise BenchError(f"profile {wanted}", "no such profile or file", known, action)
