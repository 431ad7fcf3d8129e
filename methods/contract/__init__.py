"""The contract kit: checks of what every plugin promises to the harness, on a tiny scene."""
