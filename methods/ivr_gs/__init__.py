"""iVR-GS: editable, vector-quantised Gaussians (Tang et al.)."""
