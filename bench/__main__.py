"""`python -m bench` is `golfbench`."""

from bench.cli import main

main()
