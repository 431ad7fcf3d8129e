"""A program around svox2, which imports nothing of this project."""
