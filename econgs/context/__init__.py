"""Context model and bitstream of anchors: hash grids, distributions, integer evaluation, entropy coding, container."""
