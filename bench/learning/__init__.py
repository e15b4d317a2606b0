"""Iterative learning control: what a swing did not do, the next one is told beforehand."""
