"""Steps 6 to 8: rising and learned swings, limits, causes of deviations."""
