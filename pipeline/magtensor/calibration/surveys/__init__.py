"""One fit of several surveys, with or without a scalar reference, with or without a known field direction."""
