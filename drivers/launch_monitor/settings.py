"""Settings of launch monitors: connection, and the simulator to forward shots to."""

from __future__ import annotations

from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import Annotated, Literal

from drivers.base.ranges import AtLeast, AtMost
from drivers.launch_monitor.open_connect import CLUB_CODE
from drivers.launch_monitor.record import MatchWindow

Port = Annotated[int, AtLeast(1), AtMost(65535)]


@dataclass(frozen=True)
class SimulatorSettings:
    """GSPro or another Open Connect simulator to which shots are forwarded."""

    enabled: bool = False
    """Pass shots on."""
    address: str = "127.0.0.1"
    """Address where the simulator listens."""
    port: Port = 921
    """Port; 921 is the Open Connect standard."""

    def __post_init__(self) -> None:
        """Raise ValueError if `address` is invalid."""
        _check_address("address", self.address)


@dataclass(frozen=True)
class LaunchMonitorSettings:
    """Open Connect has neither passwords nor encryption: by default it is limited to this machine."""

    enabled: bool = False
    """Listen for a launch monitor."""
    address: str = "127.0.0.1"
    """Address to listen at."""
    port: Port = 2921
    """Port; the Open Connect standard 921 needs the privilege to bind ports below 1024."""
    clients: tuple[str, ...] = ()
    """Addresses that may connect; if empty, only this machine."""
    presence: Literal["connected", "per_shot"] = "connected"
    """When a monitor counts as present: while it is connected, or while it reports the struck balls."""
    silence: Annotated[float, AtLeast(1.0), AtMost(3600.0)] = 30.0
    """Time-out of a monitor that sends heartbeats periodically or of an unreachable machine, s."""
    club: str = ""
    """Code of the club sent to monitors (DR, W3, I7, PT ...); empty to derive it from `swing.club`."""
    window: MatchWindow = field(default_factory=MatchWindow)
    simulator: SimulatorSettings = field(default_factory=SimulatorSettings)

    def __post_init__(self) -> None:
        """Raise ValueError if `club` is no code, or an address invalid or open to all without `clients`."""
        if self.club and not CLUB_CODE.fullmatch(self.club):
            raise ValueError(
                f"club: one of DR, W2 to W7, H2 to H7, I1 to I9, PW, GW, SW, LW, PT, not {self.club}"
            )
        _check_address("address", self.address)
        for client in self.clients:
            _check_address("clients", client)
        if not self.clients and not ip_address(self.address).is_loopback:
            raise ValueError(
                f"address: {self.address} is open to the network; list the allowed addresses in clients, or "
                "listen on 127.0.0.1"
            )

    def accepts(self, client: str) -> bool:
        """Return whether address `client` may connect."""
        return client in self.clients if self.clients else ip_address(client).is_loopback


def _check_address(name: str, address: str) -> None:
    try:
        ip_address(address)
    except ValueError:
        raise ValueError(f"{name}: an IP address such as 127.0.0.1 or ::1, not {address!r}") from None
