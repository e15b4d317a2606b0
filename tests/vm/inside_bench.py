"""The whole bench in the guest, run by systemd: `python -m tests.vm.inside_bench`.

Shots over the emulated card, faults of the bus in the middle of swings, a killed loop, a frozen
supervisor. Rows go to /host/rows, one JSON a line.
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback

from bench.network.lease import MAX_SECONDS
from tests.benchmarks.row import Row
from tests.vm.guest import bring_links_up, keep, keep_journal, run, say, start_nodes
from tests.vm.guest_bench import RATE, UNIT, GuestBench, install, service
from tests.vm.guest_faults import FAULTS, provoke_all
from tests.vm.guest_service import TITLE, kill_and_freeze
from tests.vm.guest_shots import look_at_wire, swing_and_measure


def main() -> int:
    """Bring the bench up and go through all of it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--interface", choices=("can", "vcan"), required=True)
    parser.add_argument("--shots", type=int, required=True)
    parser.add_argument("--faults", nargs="*", default=list(FAULTS))
    options = parser.parse_args()

    try:
        link, nodes, wire = bring_links_up(options.interface)
        configuration = install(link)
        say("installed")
        start_nodes(RATE, nodes)
        say("nodes live")
        begin = time.monotonic()
        run("systemctl", "enable", "--now", UNIT)
        keep([Row(TITLE, "start to READY=1", time.monotonic() - begin, "s", service("StatusText"))])
        bench = GuestBench(configuration)
        bench.client.take_lease("test", MAX_SECONDS)
        say("bench up")
        if options.shots:
            title = f"bench on {'emulated CAN cards' if options.interface == 'can' else 'vcan'}, virtual time"
            witness = wire if wire != link else None
            keep(swing_and_measure(bench, title, options.shots, witness))
            say("shots taken")
            keep(look_at_wire(title, bench, wire))
        if options.interface == "can" and options.faults:
            keep(provoke_all(bench, options.faults))
            bench, rows = kill_and_freeze(bench)
            keep(rows)
        bench.close()
        run("systemctl", "stop", UNIT)
        keep([Row(TITLE, "stopped in order", float(service("Result") == "success"), "", at_least=1)])
    except Exception:
        traceback.print_exc()
        return 1
    finally:
        keep_journal()
    return 0


if __name__ == "__main__":
    sys.exit(main())
