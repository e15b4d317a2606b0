"""The deciding part of the cycle: pure, compiled, time is an argument."""
