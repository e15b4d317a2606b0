"""A process of the bench, started and ready."""

from __future__ import annotations

from bench.supervisor.child_process import Child


def ready_child(module: str, plan: object, timeout: float = 100.0) -> Child:
    """Start `module` with `plan` and wait until it is ready, up to `timeout` (s); NotStarted otherwise."""
    child = Child.start(module.split(".")[1], module, plan)
    try:
        child.wait_until_ready(timeout)
    except BaseException:
        child.kill()
        raise
    return child
