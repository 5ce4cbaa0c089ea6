"""Training from the command line: a run, its progress, its curves, sweeps."""
