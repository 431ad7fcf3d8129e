"""ECoNGS: efficient compressive neural Gaussian splats (Tang and Wang)."""
