"""Models beside the compressed volume."""
