"""The processes of a running bench, what they share, and what each is watched by."""
