"""`golfbench export` at the command line: records for other programs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.base.errors import BenchError, Refused
from bench.commands.common.options import argument, flag, option
from bench.commands.common.progress import progress_bar

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.records.telemetry.recorder import SwingRecord


class Format(StrEnum):
    """Output format."""

    CSV = "csv"
    RRD = "rrd"
    MCAP = "mcap"
    MAT = "mat"
    MF4 = "mf4"


def export(
    records: Annotated[list[Path], argument("RECORD...", "Records of swings, .parquet, or folders of them.")],
    format_: Annotated[Format, option("Output format.", names="--format")],
    output: Annotated[
        Path | None, option("File for one record, folder for several.", "PATH", shown="next to each")
    ] = None,
    force: Annotated[bool, flag("--force", "Replace files that exist.")] = False,
) -> None:
    """Write records of swings for other programs, with the unit of every column.

    csv stores its units in NAME.csv-metadata.json; rrd is for Rerun, mcap for Foxglove (with a layout file),
    mat for MATLAB, mf4 (MDF 4) for CANape and NI.
    """
    from bench.records.telemetry.recorder import SwingRecord, read_swing, record_files

    targets = planned(record_files(records), format_, output, force)
    write = _writer(format_)
    with progress_bar() as progress:
        task = progress.add_task("exporting", total=len(targets))
        for source, target in targets:
            written = write(target, SwingRecord(source, *read_swing(source)))
            progress.advance(task)
            typer.echo("\n".join(map(str, written)))


def planned(
    sources: list[Path], format_: Format, output: Path | None, force: bool
) -> list[tuple[Path, Path]]:
    """Return each record with the file it is written to.

    Raises:
        Refused: a file exists, and `force` is not given.
        BenchError: two records would be written to one file.
    """
    suffix = f".{format_.value}"
    if output is not None and len(sources) == 1 and not output.is_dir():
        targets = [(sources[0], output)]
    else:
        if output is not None:
            output.mkdir(parents=True, exist_ok=True)
        targets = [(s, (output or s.parent) / f"{s.stem}{suffix}") for s in sources]
    names = [target for _, target in targets]
    for target in names:
        if names.count(target) > 1:
            found = "several records of that name"
            raise BenchError(str(target), found, "a file for each record", "Export them one by one.")
        if target.exists() and not force:
            raise Refused(
                str(target), "a file", "a name that is free", "Name another --output, or add --force."
            )
    return targets


def _writer(format_: Format) -> Callable[[Path, SwingRecord], list[Path]]:
    """Return what writes `format_`; only its own library is imported."""
    match format_:
        case Format.CSV:
            from bench.viewer.export_files import write_csv

            return write_csv
        case Format.RRD:
            from bench.viewer.recording import write_rrd

            return write_rrd
        case Format.MCAP:
            from bench.viewer.export_files import write_mcap

            return write_mcap
        case Format.MAT:
            from bench.viewer.export_files import write_mat

            return write_mat
        case Format.MF4:
            from bench.viewer.export_files import write_mf4

            return write_mf4
