"""Built-in error models."""
