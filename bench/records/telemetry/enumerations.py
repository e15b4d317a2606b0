"""Names of the codes in cycles, by enumeration."""

from __future__ import annotations

from bench.base.lifecycle import Cause, Phase, Reaction, Refusal, Request, State

ENUMERATIONS: dict[str, dict[str, str]] = {
    "state": {str(state.value): state.name for state in State},
    "request": {str(request.value): request.name for request in Request},
    "refusal": {str(refusal.value): refusal.name for refusal in Refusal},
    "phase": {str(phase.value): phase.name for phase in Phase},
    "reaction": {str(reaction.value): reaction.name for reaction in Reaction},
    "cause": {str(cause.value): cause.name for cause in Cause},
}
"""Names by code, as stored in the metadata of records; JSON keys are text."""
