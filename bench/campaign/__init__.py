"""Campaigns: their plan, runner, store, statistics and report."""
