"""Self-imitation: the premium trajectory selector."""
