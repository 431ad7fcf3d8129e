"""Context model and bitstream of anchors: grids, distributions, integers, entropy coding, container."""
