"""Anchors: training, growth, decoding to the Gaussians of a view, shading."""
