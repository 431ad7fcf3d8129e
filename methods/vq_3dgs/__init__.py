"""3D Gaussian splatting with vector-quantised attributes."""
