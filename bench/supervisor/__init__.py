"""The supervisor of a running bench: its processes, their shared files, the assessment before motion."""
