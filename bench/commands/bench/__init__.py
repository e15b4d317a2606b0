"""Commands of a running bench and its configuration."""
