"""Searches for options (``bench tune``)."""
