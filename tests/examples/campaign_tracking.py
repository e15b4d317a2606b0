"""Print how closely the joints of a campaign's swings followed their reference, shot by shot.

.venv/bin/golfbench campaign run two-balls --sim                        # writes data/campaigns/ID/swings
.venv/bin/python tests/examples/campaign_tracking.py data/campaigns/ID
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from bench.base.lifecycle import Phase
from bench.records.telemetry.record_file import read_swing
from drivers.base import JOINTS


def downswing_errors(record: Path) -> np.ndarray:
    """Return the root-mean-square following error of each joint in the downswing, (3,) in rad."""
    cycles, _ = read_swing(record)
    downswing = cycles[np.isin(cycles["phase"], (Phase.DOWNSWING, Phase.COMMITTED))]
    error = downswing["angle"] - downswing["reference_angle"]
    return np.asarray(np.sqrt(np.mean(error**2, axis=0)))


def main(campaign: Path) -> None:
    """Print a row for each record below `campaign`, then mean and standard deviation."""
    records = sorted(campaign.glob("swings/*.parquet"))
    if not records:
        raise SystemExit(f"{campaign}: no records; name a folder such as data/campaigns/ID")
    errors = 1e3 * np.array([downswing_errors(record) for record in records])
    print("rms following error in the downswing, mrad")
    print("record".ljust(12), *(joint.rjust(9) for joint in JOINTS))
    rows = {record.stem: row for record, row in zip(records, errors, strict=True)}
    for name, row in (rows | {"mean": errors.mean(0), "SD": errors.std(0)}).items():
        print(name.ljust(12), *(f"{value:9.2f}" for value in row))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    main(Path(sys.argv[1]))
