"""The bench's database: all stored data except the records of swings."""
