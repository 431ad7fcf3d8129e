"""Failures, seeds, worst views, and what grows with a scene."""
