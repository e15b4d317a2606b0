"""What stands between the cycle and the world: the contract and its implementations."""
