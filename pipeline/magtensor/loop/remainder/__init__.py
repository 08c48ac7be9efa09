"""What is left, looked at by itself: matrices that change, laws of the attitude, jitter, flagged samples."""
