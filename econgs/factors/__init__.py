"""Scenes of factors: fields that are sums of products of lines (CP decomposition), seen along rays."""
