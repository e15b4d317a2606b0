"""Records in other programs' formats, with every column's unit."""
