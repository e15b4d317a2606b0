"""A swing in lock-step, from Python: head speed over time."""

from matplotlib import pyplot

from bench.config import load_configuration
from bench.simulation.simulated_bench import Bench, PoweredBench
from bench.swing.library import find_profile
from bench.swing.profile import load_profile

file = find_profile("default")
profile = load_profile(file)
c = load_configuration().for_profile(profile, file)
bench = PoweredBench(Bench.of(c, profile))
bench.arm()
cycles = bench.swing(c.plant.ball).cycles
pyplot.plot(cycles["time"], cycles["head_speed"])
pyplot.savefig("swing.png")
