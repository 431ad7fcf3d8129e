"""Any model of Gaussians as plain ones with spherical harmonics, for viewers that know nothing else."""
