"""This machine: its load, cores, clocks, locks and provenance."""
