"""The best picture at equal cost."""
