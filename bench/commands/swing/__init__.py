"""Commands of swings: profiles, golfers, learning, records."""
