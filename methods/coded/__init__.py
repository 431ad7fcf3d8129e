"""3DGS saved by codecs of splats."""
