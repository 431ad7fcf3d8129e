"""Average differences of rate-distortion curves."""
