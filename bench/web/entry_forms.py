"""Forms of the page for measured values: the air, and the calibrations of the bench.

Each is a command of `golfbench` with its options; it checks ranges and plausibility, and its message is
shown. Nothing is overwritten: a newer entry supersedes, and a running bench takes calibrations up when it is
started again.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Any, NamedTuple

from bench.calibration.archive import calibration_of
from bench.calibration.calibration import CalibrationKind, in_words
from bench.config import Configuration, database_url
from bench.store.campaigns import CampaignStore
from bench.store.database import is_there, open_database
from bench.web.answers import InvalidBody, number_in, text_in

MAX_NOTE_LENGTH = 200
MAX_DAYS = 3650
MAX_NUMBER = 1e9
_NAMES = ("shoulder", "arm", "wrist")


class FormField(NamedTuple):
    """One measured value, or three of them, one a joint."""

    name: str
    """Option of the command, without its dashes."""
    label: str
    unit: str
    triple: bool = False
    whole: bool = False
    """Whether it counts."""
    optional: bool = False


class EntryForm(NamedTuple):
    """A form."""

    title: str
    command: tuple[str, ...]
    steps: tuple[str, ...]
    """Steps done by hand, in order."""
    fields: tuple[FormField, ...]
    club: bool = False
    """Whether it is of one club."""
    lasting: bool = True
    """Whether the entry has a method, a remark and a date of expiry."""


FORMS: Mapping[str, EntryForm] = {
    "air": EntryForm(
        "Air at the bench",
        ("campaign", "air"),
        (
            "Read temperature, humidity and station pressure (not reduced to sea level) at the bench.",
            "Shots on hardware use the reading from now on, for as long as their plan allows.",
        ),
        (
            FormField("temperature", "Temperature", "°C"),
            FormField("pressure", "Station pressure", "hPa"),
            FormField("humidity", "Relative humidity", "%"),
        ),
        lasting=False,
    ),
    "encoders": EntryForm(
        "Encoder zeros",
        ("calibrate", "encoders"),
        (
            "Disarm, open the access, and lock the robot at its mechanical reference.",
            "Enter the joint angles of that pose. The bench reads the counts itself while the robot is "
            "locked; enter them only if no bench runs.",
            "Unlock the robot, leave, end the access; restart the bench and home it.",
            "If one was mounted again, use golfbench calibrate encoders --remounted at the command line.",
        ),
        (
            FormField("from-pose", "Angles of the reference", "°", triple=True),
            FormField("uncertainty-deg", "Standard uncertainty", "°"),
            FormField("counts", "Counts at that pose", "counts", triple=True, whole=True, optional=True),
            FormField("sign", "Signs, 1 or -1", "", triple=True, whole=True, optional=True),
        ),
    ),
    "ball": EntryForm(
        "Position of the ball",
        ("calibrate", "ball"),
        (
            "Disarm, open the access, and put a ball on its tee.",
            "Measure its centre in the swing plane from the shoulder axis R1.",
            "Leave, end the access, and enter the position; restart the bench.",
        ),
        (
            FormField("x", "Towards the target, from R1", "m"),
            FormField("y", "Up the swing plane, from R1", "m"),
            FormField("uncertainty-mm", "Standard uncertainty of both", "mm"),
        ),
    ),
    "club": EntryForm(
        "Club in its mount",
        ("calibrate", "club"),
        (
            "Disarm, open the access, and clamp the club.",
            "Measure from the wrist axis R3 to the centre of the face, and loft and lie as it sits.",
            "Leave, end the access, and enter the values; restart the bench.",
        ),
        (
            FormField("length", "Wrist axis to the face", "m"),
            FormField("loft-deg", "Loft", "°"),
            FormField("lie-deg", "Lie", "°"),
            FormField("length-uncertainty-mm", "Uncertainty of the length", "mm"),
            FormField("angle-uncertainty-deg", "Uncertainty of the angles", "°"),
        ),
        club=True,
    ),
    "valves": EntryForm(
        "Valve centres",
        ("calibrate", "valves"),
        (
            "With everybody outside the guard, find for each valve the two commands at which its chambers "
            "begin to fill.",
            "Their middle is the centre, half of their distance the dead band. Restart the bench.",
        ),
        (
            FormField("centre", "Centre, -1 to 1", "", triple=True),
            FormField("dead-band", "Dead band to either side", "", triple=True),
            FormField("uncertainty", "Standard uncertainty", ""),
        ),
    ),
}
"""Forms by name; aerodynamics of balls come from files, at the command line."""


def described_forms(clubs: list[str]) -> list[dict[str, Any]]:
    """Return the forms for the browser, with the `clubs` of the configuration."""
    return [
        {
            **form._asdict(),
            "name": name,
            "fields": [field._asdict() for field in form.fields],
            "joints": _NAMES,
            "clubs": clubs if form.club else [],
        }
        for name, form in FORMS.items()
    ]


def form_arguments(form: EntryForm, body: Mapping[str, Any], by: str) -> list[str]:
    """Return the command's arguments for the values in `body`, entered `by` a person.

    Raises:
        InvalidBody: a value is missing or none.
    """
    given = dict(body)
    found = [*form.command, f"--by={by}"]
    for field in form.fields:
        found += _option(field, given.get(field.name))
    if form.lasting:
        if method := text_in(given, "method", MAX_NOTE_LENGTH, 0):
            found.append(f"--method={method}")
        if note := text_in(given, "note", MAX_NOTE_LENGTH, 0):
            found.append(f"--note={note}")
        if (days := given.get("days")) is not None:
            if isinstance(days, bool) or not isinstance(days, int) or not 1 <= days <= MAX_DAYS:
                raise InvalidBody(f"days: 1 to {MAX_DAYS}")
            found.append(f"--expires-days={days}")
    if form.club:
        found += ["--", text_in(given, "club", MAX_NOTE_LENGTH)]
    return found


def _option(field: FormField, value: Any) -> Iterator[str]:
    """Yield the option of `field` with `value`; nothing for an optional one without a value."""
    if value is None and field.optional:
        return
    if field.triple:
        if not isinstance(value, list) or len(value) != len(_NAMES):
            raise InvalidBody(f"{field.name}: three numbers")
        yield f"--{field.name}"
        yield from (_number(field, one) for one in value)
    else:
        yield f"--{field.name}={_number(field, value)}"


def _number(field: FormField, value: Any) -> str:
    """Return `value` as an argument, exactly.

    Raises:
        InvalidBody: it is no number, or no count where one is expected.
    """
    number = number_in({field.name: value}, field.name)
    if not abs(number) < MAX_NUMBER:
        raise InvalidBody(f"{field.name}: less than {MAX_NUMBER:g}")
    if field.whole and number != int(number):
        raise InvalidBody(f"{field.name}: a whole number")
    return str(int(number)) if field.whole else repr(number)


def bench_values(configuration: Configuration) -> dict[str, Any]:
    """Return calibrations in force, problems, the air, and the forms to enter newer ones.

    Raises:
        BenchError: the database cannot be read.
    """
    now = datetime.now(UTC)
    calibration = calibration_of(configuration, now)
    entries = []
    for kind in CalibrationKind:
        entry = calibration.of(kind)
        nominal = "not checked" if kind is CalibrationKind.INPUTS else "nominal, as the configuration has it"
        missing = "missing" if calibration.required else nominal
        if any(bad.kind == kind for bad in calibration.unreadable):
            missing = "unreadable"
        entries.append(
            {
                "kind": kind.value,
                "words": missing if entry is None else in_words(entry.values),
                "version": None if entry is None else entry.version,
                "by": "" if entry is None else entry.by,
                "date": None if entry is None else entry.date.isoformat(timespec="seconds"),
                "expires": None if entry is None else entry.expires.isoformat(timespec="seconds"),
                "expired": entry is not None and entry.expired(now),
            }
        )
    return {
        "club": calibration.club,
        "entries": entries,
        "problems": [problem.text for problem in calibration.problems(now)],
        "air": _air(configuration, now),
        "forms": described_forms(list(configuration.clubs)),
    }


def _air(configuration: Configuration, now: datetime) -> dict[str, Any] | None:
    """Return the newest reading of the air; None without one."""
    bench = configuration.bench
    url = database_url(bench.database, bench.data_dir)
    if not is_there(url):
        return None
    with open_database(url, now) as engine:
        found = CampaignStore(engine).newest_air(bench.id, datetime(1970, 1, 1, tzinfo=UTC))
    if found is None:
        return None
    return {
        "temperature_c": found.air.temperature - 273.15,
        "pressure_hpa": found.air.pressure / 100.0,
        "humidity_percent": 100.0 * found.air.relative_humidity,
        "date": found.date.isoformat(timespec="seconds"),
        "by": found.by,
    }
