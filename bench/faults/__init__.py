"""The fault matrix: every kind of fault, on every signal, in every phase, and how it ends."""
