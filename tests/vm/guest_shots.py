"""Ten shots over the emulated card, and what loop, wire and kernel did meanwhile."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.base.lifecycle import State
from bench.records.shot.recorded_shot import read_shot
from bench.supervisor._timing_record import SEGMENTS, summary
from drivers.canopen.frames import bus_load
from tests.benchmarks.row import Row
from tests.vm.can_bits import bits_of
from tests.vm.guest import COMMAND, OTHERS, POSITIONS, SYNC, busy_time, say
from tests.vm.guest_bench import GuestBench, alone_on_processor
from tests.vm.guest_bus import Listener, interface_counters, matches

Cycles = np.ndarray[Any, Any]

_WIRE_TIME = 3.0
"""s for which every frame is looked at."""


def swing_and_measure(bench: GuestBench, title: str, shots: int, witness: str | None) -> list[Row]:
    """Take `shots` shots; `witness` is an interface of the wire."""
    identifiers = (SYNC, COMMAND, *POSITIONS, *OTHERS)
    counter = None if witness is None else Listener(witness, identifiers, 4096)
    names = () if witness is None else ("can0", "can1", witness)
    bench.take_address()
    bench.ring.read()
    with alone_on_processor():
        before, busy = bench.timing.snapshot(), busy_time()
        counted, links = matches(witness or ""), interface_counters(*names)
    time.sleep(0.05)
    settled = bench.timing.snapshot()  # what was held up while the counters were read is over
    begin, lost_before = time.monotonic(), bench.ring.lost
    records = set(bench.configuration.bench.data_dir.glob("swings/*/*.parquet"))
    ages: list[Cycles] = []
    for swing in range(1, shots + 1):
        bench.swing()
        time.sleep(1.0)
        while bench.now()["state"] in (State.SWINGING, State.RECOVERING):
            time.sleep(0.1)
        ages.append(bench.ring.read()["encoder_age"].max(axis=1))
        if bench.now()["state"] != State.ARMED:
            raise RuntimeError(f"shot {swing} ended in {bench.words()}")
        say(f"shot {swing}")
        time.sleep(1.0)
    lasted = time.monotonic() - begin
    with alone_on_processor():
        after, busy = bench.timing.snapshot(), busy_time() - busy
        counted_after, links_after = matches(witness or ""), interface_counters(*names)
    told, ticks = summary(after, settled), summary(after, before)["ticks"]
    share = 100.0 * busy / lasted
    rows = [
        Row(title, "loop", 1e6 / told["period_us"], "Hz", f"{lasted:.1f} guest seconds, {shots} swings"),
        Row(title, "processor of the guest", share, "%", "1 GIPS; everything, the test besides"),
        Row(title, "ticks skipped", told["skipped"], f"of {told['ticks']}", at_most=0),
        *_segments(title, told),
        *_age_rows(title, np.concatenate(ages), told["period_us"], bench.ring.lost - lost_before),
    ]
    if counter is not None:
        new = {i: counted_after.get(i, 0) - counted.get(i, 0) for i in identifiers}
        more = {
            name: {what: links_after[name][what] - links[name][what] for what in links[name]}
            for name in names
        }
        rows += _sums(title, ticks, new, more, witness or "")
        counter.close()
    rows += _shots(title, bench, records, shots)
    return rows


def _segments(title: str, told: dict[str, Any]) -> list[Row]:
    rows = []
    for name in SEGMENTS:
        one = told["segments"][name]
        note = f"p99 {one['p99_us']:.0f}, longest {one['max_us']:.0f} us"
        rows.append(Row(title, f"{name}, median", one["p50_us"], "us", note))
    return rows


def _age_rows(title: str, ages: Cycles, period_us: float, lost: int) -> list[Row]:
    """Return the number of ticks with an encoder sample of another tick."""
    old = int(np.sum(ages > 0.5e-6 * period_us))
    return [
        Row(title, "ticks without all three positions", old, f"of {len(ages)}", f"{lost} not seen", at_most=0)
    ]


def _sums(
    title: str, ticks: int, new: dict[int, int], links: dict[str, dict[str, int]], witness: str
) -> list[Row]:
    """Return the frames sent, received and lost; counters not read in the same tick differ by one."""
    positions = [new[i] for i in POSITIONS]
    sent, received = links["can0"]["tx_packets"], links["can1"]["rx_packets"]
    answered, heard = links["can1"]["tx_packets"], links["can0"]["rx_packets"]
    dropped = sum(
        link[what] for link in links.values() for what in link if what not in ("tx_packets", "rx_packets")
    )
    classes = sum(new.values())
    others = classes - new[SYNC] - new[COMMAND] - sum(positions)
    return [
        Row(title, "frames of the bench lost", sent - received, f"of {sent}", "can0 to can1", 0, 0),
        Row(title, "frames of the nodes lost", answered - heard, f"of {answered}", "can1 to can0", 0, 0),
        Row(title, "frames dropped or in error", dropped, "", "by any of the three drivers", at_most=0),
        Row(
            title,
            "positions missing",
            3 * new[SYNC] - sum(positions),
            f"of {3 * new[SYNC]}",
            "three for each SYNC",
            -3,
            3,
        ),
        Row(title, "SYNCs less ticks", new[SYNC] - ticks, f"of {ticks}", "", -2, 2),
        Row(title, "commands less SYNCs", new[COMMAND] - new[SYNC], f"of {new[SYNC]}", "", -1, 1),
        Row(
            title,
            "frames on the wire less those of all classes",
            links[witness]["rx_packets"] - classes,
            f"of {links[witness]['rx_packets']}",
            f"positions {sum(positions)}, commands {new[COMMAND]}, others {others}",
            -3,
            3,
        ),
        Row(
            title,
            "frames on the wire less those sent",
            links[witness]["rx_packets"] - sent - answered,
            "",
            "",
            0,
            0,
        ),
    ]


def _shots(title: str, bench: GuestBench, before: set[Path], shots: int) -> list[Row]:
    """Return the shots in their records."""
    time.sleep(1.0)
    paths = sorted(set(bench.configuration.bench.data_dir.glob("swings/*/*.parquet")) - before)
    speeds, lost, struck = [], 0, 0
    for path in paths:
        shot = read_shot(path)
        struck += bool(shot.record.shot.ball_speed_mps)
        lost += int(shot.metadata["lost_records"])
        if (speed := shot.record.shot.club_speed_mps) is not None:
            speeds.append(speed)
    note = f"{np.mean(speeds):.2f} m/s, standard deviation {np.std(speeds, ddof=1):.2f}" if speeds[1:] else ""
    return [
        Row(title, "shots recorded", len(speeds), "", note, at_least=shots),
        Row(title, "cycles missing in their records", lost, "", at_most=0),
        Row(title, "balls struck", struck, f"of {len(paths)}", at_least=len(paths)),
    ]


def look_at_wire(title: str, bench: GuestBench, interface: str) -> list[Row]:
    """Return load and round trip of every frame on `interface` for a few seconds."""
    listener = Listener(interface)
    begin = time.monotonic()
    time.sleep(_WIRE_TIME)
    frames = [frame for frame in listener.frames() if frame.time < begin + _WIRE_TIME]
    listener.close()
    settings, period = bench.configuration.canopen, 1.0 / bench.configuration.loop.rate
    bits = sum(bits_of(frame.identifier, frame.data) for frame in frames)
    load = 100.0 * bits / _WIRE_TIME / settings.bitrate
    most = 100.0 * bus_load(settings, period, bench.configuration.driver.watchdog)
    first, commanded = _answer_times([(frame.time, frame.identifier) for frame in frames])
    return [
        Row(
            title,
            "bus load, frames really sent",
            load,
            "%",
            f"{len(frames) / _WIRE_TIME:.0f} frames a second, stuff bits counted",
            at_most=most,
        ),
        _times(title, "round trip, SYNC to the third position", first),
        _times(title, "SYNC to command", commanded),
    ]


def _times(title: str, name: str, durations: Sequence[float]) -> Row:
    p50, p99, longest = 1e6 * np.quantile(durations, [0.5, 0.99, 1.0])
    return Row(title, name, p50, "us", f"median on the wire; p99 {p99:.0f}, longest {longest:.0f} us")


def _answer_times(frames: list[tuple[float, int]]) -> tuple[list[float], list[float]]:
    """Return s from each SYNC to the last position after it, and to the command."""
    answered, commanded = [], []
    start, last, seen = 0.0, 0.0, 0
    for time_, identifier in frames:
        if identifier == SYNC:
            start, seen = time_, 0
        elif start and identifier in POSITIONS:
            last, seen = time_, seen + 1
            if seen == len(POSITIONS):
                answered.append(last - start)
        elif start and identifier == COMMAND:
            commanded.append(time_ - start)
    return answered, commanded
