"""Settings of launch monitors: connection, and the simulator to forward shots to."""

from __future__ import annotations

from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import Annotated, Literal

from drivers.base.ranges import Above, AtLeast, AtMost
from drivers.launch_monitor.matching import MatchWindow
from drivers.launch_monitor.open_connect import CLUB_CODE

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
    longest_wait: Annotated[float, Above(0.0), AtMost(600.0)] = 10.0
    """Time after which a shot that could not be forwarded is dropped, s."""

    def __post_init__(self) -> None:
        """Raise ValueError if `address` is invalid."""
        _check_address("address", self.address)


@dataclass(frozen=True)
class PlayerSettings:
    """Player in the message to monitors; several do not arm without it."""

    club: str = ""
    """Club code (DR, W3, H4, I7, PW, PT ...); empty to derive it from `swing.club`."""
    right_handed: bool = True
    """Whether the player is right-handed, as the robot is."""
    distance: Annotated[float, AtLeast(0.0), AtMost(500.0)] = 230.0
    """Distance to the target, m."""

    def __post_init__(self) -> None:
        """Raise ValueError if `club` is no code."""
        if self.club and not CLUB_CODE.fullmatch(self.club):
            raise ValueError(
                f"club: one of DR, W2 to W7, H2 to H7, I1 to I9, PW, GW, SW, LW, PT, not {self.club}"
            )


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
    seen_within: Annotated[float, AtLeast(10.0), AtMost(3600.0)] = 120.0
    """Time after a struck ball within which a monitor that connects per shot must have sent something, s."""
    silence: Annotated[float, AtLeast(1.0), AtMost(3600.0)] = 30.0
    """Time-out of a monitor that sends heartbeats, s."""
    device: str = "golfbench"
    """Device name sent to simulators."""
    window: MatchWindow = field(default_factory=MatchWindow)
    player: PlayerSettings = field(default_factory=PlayerSettings)
    simulator: SimulatorSettings = field(default_factory=SimulatorSettings)

    def __post_init__(self) -> None:
        """Raise ValueError if an address is invalid, or open to other machines without `clients`."""
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
