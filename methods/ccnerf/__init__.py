"""CCNeRF-CP: radiance fields of factors with residual groups of ranks (Tang et al. 2022)."""
