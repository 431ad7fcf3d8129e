"""All checks and figures that need a GPU, in one call on a bare machine: ``python -m tools.gpu``."""
