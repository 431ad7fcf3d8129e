"""Where methods break."""
