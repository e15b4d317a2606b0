"""The test bench: control, swings, campaigns, telemetry and the command line."""

from importlib.util import find_spec
from pathlib import Path


def _require_own(*names: str) -> None:
    """Check that the packages beside this one are found where it is, not folders of the same names.

    Raises:
        ImportError: a folder or file earlier on the import path hides one.
    """
    top = Path(__file__).resolve().parents[1]
    for name in names:
        try:
            spec = find_spec(name)
        except ValueError:  # imported without a specification
            spec = None
        places = [] if spec is None else [spec.origin or "", *(spec.submodule_search_locations or ())]
        if not any(Path(location).resolve() == top / name for location in places):
            raise ImportError(
                f"golfbench: found {name!r} in {places[-1] if places else 'no folder'}, expected it in "
                f"{top / name}: another folder or file called {name!r} comes first on the import path. "
                "Rename it, move it into a package, or start Python with -P (pytest with "
                "--import-mode=importlib)",
                name=name,
            )


_require_own("drivers", "sim")
