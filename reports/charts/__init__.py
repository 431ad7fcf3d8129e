"""Charts of the page and of papers."""
