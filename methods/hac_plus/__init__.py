"""HAC++ (Chen et al. 2025): HAC whose features say what to expect of later features of the same anchor."""
