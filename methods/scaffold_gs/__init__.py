"""Scaffold-GS (Lu et al. 2024): Gaussians decoded from anchors."""
