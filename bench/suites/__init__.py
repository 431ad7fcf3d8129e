"""Suites and what they ask for: edits, stress, ladders."""
