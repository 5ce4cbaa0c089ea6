"""Training configurations as data."""
