"""Transfer functions that were not trained on."""
