"""The plan of a campaign: its file, shot order, bench set-up, validity, carry."""
