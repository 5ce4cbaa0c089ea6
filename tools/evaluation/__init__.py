"""Measuring policies: the protocols and their report."""
