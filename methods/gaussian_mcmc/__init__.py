"""3DGS-MCMC (Kheradmand et al. 2024): a fixed number of Gaussians that move to where they are needed."""
