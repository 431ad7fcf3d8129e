"""All rows, and their means."""
