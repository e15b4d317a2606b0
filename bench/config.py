"""The configuration of a bench: one TOML file, complete or laid over another, checked before use.

A file that begins with `base = "other.toml"` gives only the keys it changes; `base = "shipped"` lays it over
the configuration that comes with golfbench. A file without `base` must give every key. Keys and units:
`bench.from_toml`. Club and ball of the plant are those that `[swing]` names; an entry of `[clubs]` or
`[balls]` that says `like = "driver"` gives only what differs from that one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import entry_points
from ipaddress import ip_address
from math import asin, ceil, hypot, isnan, pi
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from bench.control.settings import (
    MODEL_PHASES,
    ControlSettings,
    EnvelopeSettings,
    EstimatorSettings,
    HomingSettings,
    LifecycleSettings,
    ModelSettings,
)
from bench.errors import BenchError
from bench.from_toml import Builder, Leaf, Tree, as_tree, format_value, laid_over, place_of, read_toml
from drivers.base.ranges import Range, short
from drivers.canopen.settings import CanopenSettings
from drivers.daq.settings import DaqSettings
from drivers.launch_monitor.settings import LaunchMonitorSettings
from sim.air import Air
from sim.ball import Ball
from sim.faults import LONGEST_DELAY, Fault
from sim.flight import Wind
from sim.plant import HISTORY, PlantParameters
from sim.robot import Club
from sim.turf import Turf

if TYPE_CHECKING:
    from sqlalchemy import URL

SHIPPED = "shipped"
VARIANTS = Path(__file__).with_name("configurations")
"""Folder of the variants that come with golfbench; their names stand for their paths."""

LONGEST_SUBSTEP = 0.00025
"""s; the plant's delivery is converged up to this internal step."""

LONGEST_ANSWER = 0.7
"""Share of the loop's period that a tick may wait for the encoders; the rest is for deciding."""

COST_OF_A_SYNC = 2.2
"""Ticks without a sample when a SYNC is lost: its own, the next, whose sample might be the answer to it, and
what a tick may be late."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
"""Of somebody in a certificate."""

_PASSWORD = re.compile(r"(//[^:/@]*:)[^/]*@")
_DERIVED = frozenset({"plant.tick", "plant.ball", "plant.robot.club", "files"})


@dataclass(frozen=True)
class BenchSettings:
    """Who this bench is and where it stores things."""

    id: str
    """Part of every address on the network."""
    data_dir: Path
    """Relative to the working directory."""
    database: str = ""
    """URL; empty is SQLite in `data_dir`."""


@dataclass(frozen=True)
class LoopSettings:
    """The control loop."""

    rate: Annotated[float, Range(100.0, 5000.0, "Hz")]
    realtime: Literal["off", "prefer", "require"]
    priority: Annotated[int, Range(1, 98, "")]
    """SCHED_FIFO's."""
    cpu: Annotated[int, Range(-1, 1023, "")]
    """The core the loop stays on; -1: any."""


@dataclass(frozen=True)
class DriverSettings:
    """What the loop drives."""

    name: str
    time: Literal["wall", "paced"]
    """Of the `sim` driver: the plant on its own clock in its own process, or in step with the ticks."""
    watchdog: Annotated[float, Range(0.005, 0.5, "s")]
    """Silence after which the device itself goes passive."""

    @property
    def paced(self) -> bool:
        """Whether a simulated plant runs in step with the loop's ticks; else time is the wall's."""
        return self.name == "sim" and self.time == "paced"


@dataclass(frozen=True)
class NetworkSettings:
    """Where the daemon listens and clients connect, and who may do what from other machines."""

    endpoint: str
    """zenoh endpoint: of the daemon on its own machine; of a client elsewhere, the daemon's `beyond`."""
    beyond: str = ""
    """Where the daemon also listens, by TLS; empty: nowhere."""
    router: str = ""
    """zenoh router that the daemon connects to; empty: none."""
    identity: str = ""
    """Path, without ending, of this side's certificate (.pem) and key (.key); authority.pem beside them."""
    viewers: tuple[str, ...] = ()
    """Names in certificates of those who may look."""
    operators: tuple[str, ...] = ()
    """Names of those who may also command; a router counts as one."""


@dataclass(frozen=True)
class SwingSettings:
    """What is swung when a command does not say."""

    profile: str
    """Name of a profile that comes with golfbench, or a path."""
    club: str
    ball: str


@dataclass(frozen=True)
class Configuration:
    """A checked configuration, SI and radians."""

    bench: BenchSettings
    loop: LoopSettings
    driver: DriverSettings
    canopen: CanopenSettings
    daq: DaqSettings
    launch_monitor: LaunchMonitorSettings
    network: NetworkSettings
    swing: SwingSettings
    plant: PlantParameters
    """With the club and the ball of `swing` and the loop's period as its tick."""
    control: ControlSettings
    lifecycle: LifecycleSettings
    homing: HomingSettings
    envelope: EnvelopeSettings
    estimator: EstimatorSettings
    clubs: dict[str, Club]
    balls: dict[str, Ball]
    air: Air
    wind: Wind
    turf: Turf
    faults: dict[str, Fault] = field(default_factory=dict)
    """What breaks while the simulated robot runs, by name."""
    files: tuple[Path, ...] = field(default=(), compare=False)
    """Where it comes from, the base first."""

    def plant_with(self, *, club: str | None = None, ball: str | None = None) -> PlantParameters:
        """Return the plant with another club or ball of this configuration.

        Raises:
            BenchError: there is none of that name.
        """
        plant = self.plant
        if club is not None:
            plant = replace(plant, robot=replace(plant.robot, club=_choice(self, "clubs", club)))
        return plant if ball is None else replace(plant, ball=_choice(self, "balls", ball))

    def with_driver(self, driver: DriverSettings) -> Configuration:
        """Return the configuration with another driver, and what follows from it.

        The model's limits are the simulated plant's: with any other driver that check is off, unless it is
        asked for "always".
        """
        envelope = self.envelope
        if driver.name != "sim" and envelope.model.check == "simulated":
            envelope = envelope.with_model_check("off")
        return replace(self, driver=driver, envelope=envelope)

    def running(self) -> Configuration:
        """Return the configuration of a bench that runs.

        A plant on a clock of its own obeys some part of a tick earlier or later than the model has it, which
        the model's limits do not allow for.
        """
        if self.driver.paced or self.envelope.model.check != "simulated":
            return self
        return replace(self, envelope=self.envelope.with_model_check("off"))

    @property
    def is_machine(self) -> bool:
        """Whether something real moves; a bus of processes of this machine has only simulated nodes on it."""
        if self.driver.name == "canopen":
            return self.canopen.interface != "local_socket"
        return self.driver.name not in {"sim", "mock"}

    def driver_arguments(self) -> dict[str, Any]:
        """Return the keyword arguments that the factory of the driver `driver.name` takes."""
        settings = {"canopen": self.canopen, "daq": self.daq}.get(self.driver.name)
        if settings is None:
            return {}
        return {
            "settings": settings,
            "period": 1.0 / self.loop.rate,
            "watchdog": self.driver.watchdog,
            "counts_per_revolution": self.plant.encoders.counts_per_revolution,
        }

    def effective(self) -> dict[str, Any]:
        """Return all values nested as in the file, SI and radians, for records and reports; no password."""
        shown_here = replace(self.bench, database=_PASSWORD.sub(r"\1***@", self.bench.database))
        return {name: _plain(value) for name, value in asdict(replace(self, bench=shown_here)).items()}


def shipped_configuration() -> Path:
    """Return the path of the configuration that comes with golfbench."""
    installed = Path(__file__).with_name("config.toml")
    return installed if installed.exists() else Path(__file__).parent.parent / "config.toml"


def find_configuration(wanted: Path | None = None) -> Path:
    """Return the file for `wanted`: a path or the name of a variant.

    Without it: `config.toml` in the working directory, else the shipped one.

    Raises:
        BenchError: there is no such file.
    """
    if wanted is None:
        here = Path("config.toml")
        return here if here.exists() else shipped_configuration()
    if wanted.exists():
        return wanted
    if wanted == Path(SHIPPED):
        return shipped_configuration()
    variant = VARIANTS / f"{wanted}.toml"
    if len(wanted.parts) == 1 and variant.exists():
        return variant
    known = ", ".join([SHIPPED, *sorted(path.stem for path in VARIANTS.glob("*.toml"))])
    raise BenchError(
        str(wanted), "no such file", f"a configuration file, or one of {known}", "Correct the path."
    )


def load_configuration(path: Path | None = None) -> Configuration:
    """Return the checked configuration at `path` (as `find_configuration` takes it).

    Raises:
        BenchError: a file is missing, cannot be read, or is no TOML.
        ExceptionGroup: of BenchErrors, one for each mistake in the files.
    """
    faults: list[BenchError] = []
    file = find_configuration(path)
    tree, files = _read(file, faults, ())
    for section in ("clubs", "balls"):
        _complete_likes(tree, section, file, faults)
    add = (
        f'Add it, as {_name(shipped_configuration())} has it, or begin {_name(file)} with base = "{SHIPPED}".'
    )
    cure = f"Correct the value; its unit and meaning stand beside it in {_name(shipped_configuration())}."
    builder = Builder(tree, file, cure, add, _DERIVED, faults)
    configuration = builder.build(Configuration)
    if configuration is not None:
        configuration = _with_derived(configuration, files)
        for check in _CHECKS:
            for key, found, wanted, mend in check(configuration, tree):
                faults.append(BenchError(place_of(tree, file, key), found, wanted, mend))
    if faults:
        # Entries that are like another one repeat its mistakes.
        once = {str(fault): fault for fault in faults}
        raise ExceptionGroup(f"{file} does not hold", list(once.values()))
    return configuration  # type: ignore[no-any-return]


def contradictions(configuration: Configuration) -> list[BenchError]:
    """Return what does not hold together in a configuration that was changed after it was loaded."""
    place = ", ".join(map(str, configuration.files))
    return [
        BenchError(f"{place}: {key}", found, wanted, mend)
        for check in _CHECKS
        for key, found, wanted, mend in check(configuration, {})
    ]


def _read(file: Path, faults: list[BenchError], above: tuple[Path, ...]) -> tuple[Tree, tuple[Path, ...]]:
    """Return the tree of `file` over its base, and the files it comes from; `above` are those based on it."""
    file = _name(file)
    tables = read_toml(file, "a configuration file", "Correct the path.")
    base = tables.pop("base", None)
    tree = as_tree(tables, file, faults)
    if base is None:
        return tree, (file,)
    if not isinstance(base, str):
        raise BenchError(f"{file}: base", format_value(base), f'a path or "{SHIPPED}"', "Correct it.")
    below = shipped_configuration() if base == SHIPPED else file.parent / base
    seen = [path.resolve() for path in (*above, file)]
    if below.resolve() in seen:
        raise BenchError(
            f"{file}: base", format_value(base), "a file that is not based on this one", "Break the circle."
        )
    if not below.exists():
        expected = f'a path from this file\'s folder, or "{SHIPPED}"'
        raise BenchError(
            f"{file}: base", f"{format_value(base)}, no such file", expected, "Correct the path."
        )
    under, files = _read(below, faults, (*above, file))
    return laid_over(under, tree), (*files, file)


def _name(file: Path) -> Path:
    """Return `file` relative to the working directory when it lies in it."""
    resolved, here = file.resolve(), Path.cwd()
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
    """Return `c` with what follows from other keys: tick, club and ball of the plant."""
    club, ball = c.clubs.get(c.swing.club), c.balls.get(c.swing.ball)
    robot = c.plant.robot if club is None else replace(c.plant.robot, club=club)
    plant = replace(c.plant, robot=robot, tick=1.0 / c.loop.rate, ball=ball or c.plant.ball)
    return replace(c, plant=plant, files=files).with_driver(c.driver)


def _choice(c: Configuration, section: str, name: str) -> Any:
    entries = getattr(c, section)
    if name in entries:
        return entries[name]
    files = ", ".join(map(str, c.files))
    raise BenchError(
        f"{files}: {section}", f"no {format_value(name)}", f"one of {', '.join(entries)}", "Add or rename it."
    )


def _plain(value: Any) -> Any:
    match value:
        case dict():
            return {key: _plain(item) for key, item in value.items()}
        case list() | tuple():
            return [_plain(item) for item in value]
        case Path():
            return str(value)
        case float() if isnan(value):
            return None
        case _:
            return value


# What several keys must hold together ----------------------------------------------------------------

DATABASE_FILE = "golfbench.sqlite"


def database_url(database: str, data_dir: Path) -> URL:
    """Return where the database is: the URL `database`, or SQLite's file in `data_dir` when that is empty.

    Raises:
        BenchError: `database` is no URL of a database that several processes can open.
    """
    from sqlalchemy import URL, make_url  # slow to import, and needed only here
    from sqlalchemy.exc import ArgumentError, NoSuchModuleError

    if not database:
        return URL.create("sqlite", database=str(data_dir / DATABASE_FILE))
    cure = 'Correct it, or leave it empty ("") for SQLite in data_dir.'
    wanted = "a URL such as sqlite:////var/lib/golfbench/bench.sqlite or postgresql+psycopg://host/golfbench"
    try:
        url = make_url(database)
        url.get_dialect()
    except (ArgumentError, NoSuchModuleError, ValueError):
        raise BenchError("bench.database", "no URL that SQLAlchemy knows", wanted, cure) from None
    if url.get_backend_name() == "sqlite" and url.database in {None, "", ":memory:"}:
        raise BenchError("bench.database", "SQLite without a file", wanted, cure)
    return url


Mistake = tuple[str, str, str, str]
"""Key, found, expected, cure."""


def _names(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,62}", c.bench.id):
        yield (
            "bench.id",
            format_value(c.bench.id),
            "letters, digits, - and _, at most 63",
            "It is part of addresses.",
        )
    if c.bench.database:
        try:
            database_url(c.bench.database, c.bench.data_dir)
        except BenchError as error:
            yield error.place, error.found, error.expected, error.cure
    for key, entries in (("club", c.clubs), ("ball", c.balls)):
        name = getattr(c.swing, key)
        if name not in entries:
            known = f"one of {', '.join(entries) or 'none'}"
            yield f"swing.{key}", format_value(name), known, f"Choose one, or add [{key}s.{name}]."
    drivers = sorted({entry.name for entry in entry_points(group="golfbench.drivers")})
    if c.driver.name not in drivers:
        cure = "Choose one, or install the plug-in that brings it."
        yield "driver.name", format_value(c.driver.name), f"one of {', '.join(drivers)}", cure
    if c.driver.name == "daq" and c.homing.method != "index":
        cure = "The card's counters know no angle until the index has passed."
        yield "homing.method", format_value(c.homing.method), 'with driver "daq" "index"', cure
    phases = EnvelopeSettings().following.keys()
    for name in phases ^ c.envelope.following.keys():
        found = "nothing" if name in phases else "an unknown phase"
        yield f"envelope.following.{name}", found, f"each of {', '.join(phases)} once", "Correct the table."
    for kind in MODEL_PHASES:
        watched = getattr(ModelSettings(), kind).keys()
        for name in getattr(c.envelope.model, kind).keys() ^ watched:
            found = "nothing" if name in watched else "an unknown phase"
            expected = f"each of {', '.join(watched)} once"
            yield f"envelope.model.{kind}.{name}", found, expected, "Correct the table."


def _network(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    network, inside = c.network, "tcp/127.0.0.1:PORT or tcp/[::1]:PORT, an address of this machine only"
    beyond = "tls/HOST:PORT: commands in the clear would be anybody's beyond this machine"
    places = (
        ("endpoint", network.endpoint, f"{inside}, or {beyond}", _is_loopback, _is_secure),
        ("beyond", network.beyond, f'"", or {beyond}', _is_empty, _is_secure),
        ("router", network.router, f'"", {inside}, or {beyond}', _is_empty, _is_loopback, _is_secure),
    )
    for name, endpoint, wanted, *allowed in places:
        if not any(allow(endpoint) for allow in allowed):
            yield f"network.{name}", format_value(endpoint), f"{wanted}; PORT 1 to 65535", "Correct it."
        elif _is_secure(endpoint) and not network.identity:
            found = f"none, with {name} = {format_value(endpoint)}"
            cure = "Make them: golfbench certificates."
            yield "network.identity", found, "path of certificate and key, without ending", cure
    for role in ("viewers", "operators"):
        for name in getattr(network, role):
            if not NAME.fullmatch(name):
                wanted = "names as in certificates: letters, digits, ., - and _, at most 63"
                yield f"network.{role}", format_value(name), wanted, "Correct it."


def _is_empty(endpoint: str) -> bool:
    return endpoint == ""


def _is_loopback(endpoint: str) -> bool:
    form = re.fullmatch(r"tcp/(?:\[(?P<six>[0-9a-f:]+)\]|(?P<four>[0-9.]+)):(?P<port>[0-9]{1,5})", endpoint)
    try:
        return form is not None and ip_address(form["six"] or form["four"]).is_loopback and _is_port(form)
    except ValueError:
        return False


def _is_secure(endpoint: str) -> bool:
    form = re.fullmatch(r"tls/(?:\[[0-9a-f:]+\]|[A-Za-z0-9.-]+):(?P<port>[0-9]{1,5})", endpoint)
    return form is not None and _is_port(form)


def _is_port(form: re.Match[str]) -> bool:
    return 1 <= int(form["port"]) <= 65535


def _actuators(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    for name in ("shoulder", "right_arm", "wrist"):
        actuator, key = getattr(c.plant, name), f"plant.{name}"
        if not actuator.lower < actuator.upper:
            found = f"{short(actuator.lower)}, with upper {short(actuator.upper)}"
            yield f"{key}.lower", found, "less than upper", "Correct one of the two."
        friction = actuator.friction
        if friction.static < friction.coulomb:
            found = f"{short(friction.static)}, with coulomb {short(friction.coulomb)}"
            yield f"{key}.friction.static", found, "at least coulomb", "Correct one of the two."
        if actuator.pressure_rating < c.plant.supply.pressure:
            found = f"{short(actuator.pressure_rating)} Pa"
            least = f"at least the supply's {short(c.plant.supply.pressure)} Pa"
            yield f"{key}.pressure_rating", found, least, "Lower plant.supply.pressure."
        travel = actuator.upper - actuator.lower + 4 * actuator.stop.travel
        if name != "right_arm" and travel >= 2 * pi:
            found = f"{short(travel)} rad of travel with twice the cushions"
            yield f"{key}.upper", found, "less than one turn, all that the encoder sees", "Narrow the range."


def _linkage(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    robot, arm, wrist = c.plant.robot, c.plant.right_arm, c.plant.wrist
    shortest, longest = abs(robot.l62 - robot.l23) - robot.l56, robot.l62 + robot.l23 - robot.l56
    low, high = max(0.0, shortest), min(robot.stroke, longest)
    for end in ("lower", "upper"):
        key, position = f"plant.right_arm.{end}", getattr(arm, end)
        if not low <= position <= high:
            wanted = f"{low:.4g} to {high:.4g} m: inside the rod's stroke and the linkage's reach"
            yield key, f"{short(position)} m", wanted, "Correct it, or the robot's lengths."
        leaf = _leaf(tree, key)
        if leaf is not None and leaf.suffix:
            yield key, format_value(leaf.value), "a rod extension in m", f"Write {end} = ... in m."
        # Thesis figure 11: the cylinder turns the wrist with lever d sin(beta), beta = theta3 - 3 pi / 2.
        dead = asin(c.envelope.least_lever)
        theta3 = getattr(wrist, end)
        if not 1.5 * pi + dead <= theta3 <= 2.5 * pi - dead:
            span = f"{270 + dead * 180 / pi:.1f} to {450 - dead * 180 / pi:.1f} deg"
            cure = "Narrow the range; envelope.least_lever says how little lever may be left."
            yield (
                f"plant.wrist.{end}",
                f"{theta3 * 180 / pi:.1f} deg",
                f"{span}: where the lever turns it",
                cure,
            )


def _leaf(tree: Tree, path: str) -> Leaf | None:
    node: Any = tree
    for part in path.split("."):
        node = node.get(part, {})
    return node if isinstance(node, Leaf) else None


def _times(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    substep = c.plant.tick / c.plant.substeps
    if substep > LONGEST_SUBSTEP * (1 + 1e-9):
        least = -(-c.plant.tick // LONGEST_SUBSTEP)
        found = f"{c.plant.substeps}, internal steps of {1e3 * substep:.3g} ms at {short(c.loop.rate)} Hz"
        wanted = (
            f"at least {least:.0f}: steps of {1e3 * LONGEST_SUBSTEP:g} ms, up to which the plant is converged"
        )
        yield "plant.substeps", found, wanted, "Raise it."
    longest = (HISTORY - 2) * substep
    if c.plant.encoders.latency > longest:
        found = f"{short(c.plant.encoders.latency)} s"
        yield "plant.encoders.latency", found, f"at most {short(longest)} s with these substeps", "Lower it."
    for name in ("lost_time", "greatest_gap"):
        value = getattr(c.envelope, name)
        if value <= c.plant.tick:
            found, wanted = f"{short(value)} s", f"more than one tick, {short(c.plant.tick)} s"
            yield f"envelope.{name}", found, wanted, "Raise it, or loop.rate."
    lost, gap = c.envelope.lost_time, c.envelope.greatest_gap
    if lost > gap:
        wanted = f"at most envelope.greatest_gap, {short(gap)} s"
        yield "envelope.lost_time", f"{short(lost)} s", wanted, "Lower it."


def _air(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    supply, least = c.plant.supply, c.envelope.least_supply
    if not supply.atmosphere < least < supply.pressure:
        wanted = (
            f"more than the atmosphere's {short(supply.atmosphere)}, less than {short(supply.pressure)} Pa"
        )
        yield "envelope.least_supply", f"{short(least)} Pa", wanted, "Correct it; pressures are Pa absolute."
    if c.envelope.greatest_supply <= supply.pressure:
        found, wanted = f"{short(c.envelope.greatest_supply)} Pa", f"more than {short(supply.pressure)} Pa"
        yield "envelope.greatest_supply", found, wanted, "Correct it; pressures are Pa absolute."
    if c.envelope.minimum_stop_margin > 1.0:
        found = short(c.envelope.minimum_stop_margin)
        yield "envelope.minimum_stop_margin", found, "0 to 1, a share of the cushions' travel", "Lower it."


def _site(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    site, robot = c.plant.site, c.plant.robot
    lowest = site.ground + c.plant.ball.radius
    if site.ball_y < lowest - 1e-6:
        found, wanted = f"{short(site.ball_y)} m", f"at least {lowest:.4f} m, the ball's centre on the ground"
        yield "plant.site.ball_y", found, wanted, "Raise it; y0 points up."
    reach = robot.l12 + robot.l23 + robot.club.length_to_face
    distance = hypot(site.ball_x, site.ball_y)
    if distance > reach:
        found, wanted = f"{distance:.3f} m from the shoulder axis", f"at most {reach:.3f} m, arm and club"
        yield "plant.site.ball_y", found, wanted, "Move the ball nearer, or take a longer club."


def _bus(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    if c.driver.name != "canopen":
        return
    from drivers.canopen.frames import GREATEST_LOAD, bus_load, greatest_rate

    bus, period = c.canopen, 1.0 / c.loop.rate
    load = bus_load(bus, period, c.driver.watchdog)
    if load > GREATEST_LOAD:
        found = f"{bus.bitrate} bit/s, a bus load of {load:.0%} at {short(c.loop.rate)} Hz"
        slower = int(greatest_rate(bus, c.driver.watchdog))
        yield (
            "canopen.bitrate",
            found,
            f"at most {GREATEST_LOAD:.0%}",
            f"Raise it, or set loop.rate to {slower} Hz.",
        )
    lost = c.envelope.lost_time
    if lost < COST_OF_A_SYNC * period:
        found = f"{short(lost)} s at {short(c.loop.rate)} Hz"
        least, faster = short(COST_OF_A_SYNC * period), ceil(COST_OF_A_SYNC / lost)
        wanted = f"at least {COST_OF_A_SYNC:g} ticks, {least} s: a lost SYNC costs two samples"
        cure = f"Set loop.rate to {faster} Hz or more, or raise it: 0.009 s was proven safe."
        yield "envelope.lost_time", found, wanted, cure
    longest = LONGEST_ANSWER * period
    if bus.answer_time > longest:
        found = f"{short(bus.answer_time)} s"
        yield "canopen.answer_time", found, f"at most {short(longest)} s, part of the period", "Lower it."


def unheard_phases(configuration: Configuration) -> list[BenchError]:
    """Return the faults that would never begin on a bench that runs: only a plant in step hears the phase."""
    if configuration.driver.paced:
        return []
    place = ", ".join(map(str, configuration.files))
    return [
        BenchError(
            f"{place}: faults.{name}.phase", format_value(fault.phase),
            '"any": a plant on its own clock knows no phase',
            "Give time, or joint and angle, or run with --time paced.",
        )
        for name, fault in configuration.faults.items()
        if fault.phase != "any"
    ]  # fmt: skip


_LOOPS_OWN = frozenset({"clock", "loop", "supervisor", "recorder", "lease", "launch monitor"})


def _faults(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    """Faults belong to a simulated robot, and only to what a running bench can spoil of it."""
    for name, fault in c.faults.items():
        key = f"faults.{name}"
        if c.is_machine or c.driver.name == "mock":
            found, wanted = (
                f"a fault, with driver {format_value(c.driver.name)}",
                'none: faults are for driver "sim"',
            )
            yield key, found, f"{wanted} and simulated nodes", "Delete it, or set driver.name."
        if fault.signal in _LOOPS_OWN:
            cure = "End or freeze the process itself; `golfbench faults run` tries the rest."
            yield f"{key}.signal", format_value(fault.signal), "a signal or part of the simulated robot", cure
        if fault.kind == "delayed" and fault.value > (longest := LONGEST_DELAY * c.plant.tick):
            yield f"{key}.value", f"{short(fault.value)} s", f"at most {short(longest)} s", "Lower it."


_CHECKS: tuple[Callable[[Configuration, Tree], Iterator[Mistake]], ...] = (
    _names, _network, _actuators, _linkage, _times, _air, _site, _bus, _faults,
)  # fmt: skip
