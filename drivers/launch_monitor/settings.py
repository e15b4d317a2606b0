"""Where launch monitors connect, what they may tell, and where our shots go."""

from __future__ import annotations

from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import Annotated

from annotated_types import Ge, Gt, Le

from drivers.launch_monitor.matching import MatchWindow
from drivers.launch_monitor.plausibility import PlausibleFigures

Port = Annotated[int, Ge(1), Le(65535)]


@dataclass(frozen=True)
class SimulatorSettings:
    """GSPro, or what speaks as it does, that is told of our shots."""

    enabled: bool = False
    """Pass shots on."""
    address: str = "127.0.0.1"
    """Address where the simulator listens."""
    port: Port = 921
    """Open Connect's own."""
    longest_wait: Annotated[float, Gt(0.0), Le(600.0)] = 10.0
    """s after which a shot that could not be passed on is no news any more."""

    def __post_init__(self) -> None:
        """Raise ValueError when `address` is none."""
        _check_address("address", self.address)


@dataclass(frozen=True)
class LaunchMonitorSettings:
    """Open Connect has neither passwords nor encryption: it stays on this machine unless told otherwise."""

    enabled: bool = False
    """Listen for a launch monitor."""
    address: str = "127.0.0.1"
    """Where we listen."""
    port: Port = 2921
    """Open Connect's own, 921, takes the privilege to bind ports below 1024."""
    clients: tuple[str, ...] = ()
    """Addresses that may connect; empty: this machine's only."""
    silence: Annotated[float, Ge(1.0), Le(3600.0)] = 30.0
    """s after which a monitor that has sent heartbeats is taken for gone."""
    device: str = "golfbench"
    """What we call ourselves towards simulators."""
    window: MatchWindow = field(default_factory=MatchWindow)
    plausible: PlausibleFigures = field(default_factory=PlausibleFigures)
    simulator: SimulatorSettings = field(default_factory=SimulatorSettings)

    def __post_init__(self) -> None:
        """Raise ValueError when an address is none, or others than this machine could connect unnamed."""
        _check_address("address", self.address)
        for client in self.clients:
            _check_address("clients", client)
        if not self.clients and not ip_address(self.address).is_loopback:
            raise ValueError(
                f"address: {self.address} is open to the network; name in clients who may connect, or listen "
                "on 127.0.0.1"
            )

    def lets_in(self, client: str) -> bool:
        """Tell whether who calls from `client` may connect."""
        return client in self.clients if self.clients else ip_address(client).is_loopback


def _check_address(name: str, address: str) -> None:
    try:
        ip_address(address)
    except ValueError:
        raise ValueError(f"{name}: an IP address as 127.0.0.1 or ::1, not {address!r}") from None
