"""The results of a sweep in a file of JSON lines: they are not run again."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

Result = TypeVar("Result")

_SCHEMA = 2


class SweepStore(Generic[Result]):
    """Results of one sweep by case, and the time that they took."""

    def __init__(
        self,
        path: Path,
        digest: str,
        encode: Callable[[Result], dict[str, Any]],
        decode: Callable[[dict[str, Any]], Result],
    ) -> None:
        """Read the stored results; a file of another `digest` is replaced, a torn last line dropped.

        `digest` is of all that results depend on. `encode` makes JSON of a result, `decode` reads it.
        """
        self.path = path
        self._encode = encode
        self.results: dict[str, Result] = {}
        self.seconds = 0.0
        """Time that the results took over all runs, s."""
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        header = {"schema": _SCHEMA, "digest": digest}
        if not lines or _parsed(lines[0]) != header:
            lines = [json.dumps(header)]
        kept = lines[:1]
        for line in lines[1:]:
            record = _parsed(line)
            if "seconds" in record:
                self.seconds += float(record["seconds"])
                kept.append(line)
            elif record:
                self.results[record["case"]] = decode(record["result"])
                kept.append(line)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(kept) + "\n")

    def add(self, results: Mapping[str, Result]) -> None:
        """Store `results` by case."""
        self.results.update(results)
        lines = [
            json.dumps({"case": case, "result": self._encode(result)}) for case, result in results.items()
        ]
        with self.path.open("a", encoding="utf-8") as file:
            file.write("".join(f"{line}\n" for line in lines))

    def took(self, seconds: float) -> None:
        """Store the duration of a run."""
        self.seconds += seconds
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"seconds": round(seconds, 1)}) + "\n")


def _parsed(line: str) -> dict[str, Any]:
    try:
        record = json.loads(line)
    except ValueError:
        return {}
    return record if isinstance(record, dict) else {}
