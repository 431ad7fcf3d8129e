"""Runs a plan: executors, workers, limits, display."""
