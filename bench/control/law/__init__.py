"""Control laws: PID, its gains and margins, feed-forward."""
