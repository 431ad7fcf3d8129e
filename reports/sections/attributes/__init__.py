"""What primitives carry, and what the features of anchors tell."""
