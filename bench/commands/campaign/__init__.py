"""Commands of campaigns, and the demo."""
