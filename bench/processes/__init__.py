"""The processes of a running bench, their shared files and their supervision."""
