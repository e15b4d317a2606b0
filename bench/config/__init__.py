"""The configuration of a bench: its values, the files they come from, the rules they keep."""

from bench.base.address import DATABASE_FILE, NAME, BenchSettings, NetworkSettings, database_url
from bench.base.configuration_files import (
    SHIPPED,
    VARIANTS,
    find_configuration,
    shipped_configuration,
    variants_with,
)
from bench.config._rules import contradictions, unheard_phases
from bench.config._settings import Configuration, DriverSettings, LoopSettings, SwingSettings
from bench.config.files import load_configuration

__all__ = [
    "DATABASE_FILE",
    "NAME",
    "SHIPPED",
    "VARIANTS",
    "BenchSettings",
    "Configuration",
    "DriverSettings",
    "LoopSettings",
    "NetworkSettings",
    "SwingSettings",
    "contradictions",
    "database_url",
    "find_configuration",
    "load_configuration",
    "shipped_configuration",
    "unheard_phases",
    "variants_with",
]
