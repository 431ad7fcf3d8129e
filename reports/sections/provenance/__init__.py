"""Which code ran where."""
