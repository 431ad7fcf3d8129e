"""HAC (Chen et al. 2024): the anchors of Scaffold-GS, quantised and coded with a hash-grid context."""
