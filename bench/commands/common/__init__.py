"""Parts that commands share: session, options, output, progress."""
