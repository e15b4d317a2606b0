"""Steps 0 to 5: inputs, wiring, slow moves, response times."""
