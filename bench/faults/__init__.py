"""Every kind of fault, on every signal, in every phase: what becomes of robot and bench."""
