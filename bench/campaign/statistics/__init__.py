"""Statistics of a campaign: comparisons, power, control chart, preview."""
