"""Cost of rendering the volumes."""
