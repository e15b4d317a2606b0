"""Iterative learning control: the errors of a swing correct the next one beforehand."""
