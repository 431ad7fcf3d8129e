"""VEG: Gaussians that carry a scalar, shown through any transfer function (Dyken et al.)."""
