"""`python -m bench` is `golfbench`."""

from bench.commands.cli import main

main()
