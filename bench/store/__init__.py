"""The bench's database: what is kept beside the records of the swings."""
