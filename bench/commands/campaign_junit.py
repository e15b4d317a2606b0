"""A campaign as JUnit XML: a test case for each planned shot, and for each band of a baseline."""

from __future__ import annotations

import re
from collections.abc import Sequence
from xml.etree import ElementTree

from bench.campaign.randomization import Role
from bench.campaign.runner import RunOutcome
from bench.commands.campaign_baseline import Checked
from bench.shot.shot import Shot, ShotStatus
from bench.store.records import CampaignEntry, CampaignState

_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def junit_xml(
    entry: CampaignEntry, outcome: RunOutcome, shots: Sequence[Shot], checks: Sequence[Checked] = ()
) -> bytes:
    """Return the XML; a planned shot fails when its last attempt was not valid."""
    last: dict[tuple[int, int], Shot] = {
        (shot.block, shot.position): shot for shot in shots if shot.role != Role.WARM_UP
    }
    cases: list[tuple[str, str, str]] = [
        (
            f"block {block} position {position}: {shot.ball}, {shot.club}, {shot.swing}",
            "shots",
            "" if shot.status is ShotStatus.VALID else f"{shot.status}: {shot.reason}",
        )
        for (block, position), shot in sorted(last.items())
    ]
    ended = outcome.state is CampaignState.FINISHED
    cases.append(("came to its end", "campaign", "" if ended else f"{outcome.state}: {outcome.reason}"))
    cases += [(check.band.path, "baseline", "" if check.holds else str(check)) for check in checks]
    failures = sum(bool(trouble) for _, _, trouble in cases)
    suite = ElementTree.Element(
        "testsuite",
        name=entry.id,
        tests=str(len(cases)),
        failures=str(failures),
        errors="0",
        timestamp=f"{entry.date:%Y-%m-%dT%H:%M:%S}",
    )
    for name, group, trouble in cases:
        case = ElementTree.SubElement(
            suite, "testcase", classname=f"{entry.name}.{group}", name=_FORBIDDEN.sub("?", name)
        )
        if trouble:
            ElementTree.SubElement(case, "failure", message=_FORBIDDEN.sub("?", trouble))
    text: bytes = ElementTree.tostring(suite, encoding="utf-8", xml_declaration=True)
    return text
