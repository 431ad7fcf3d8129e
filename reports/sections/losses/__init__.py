"""The parts of the training loss."""
