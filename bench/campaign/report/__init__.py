"""The report of a campaign: findings, verdicts, budgets, pictures, its record."""
