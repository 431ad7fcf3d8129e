"""The volume, compressed by SZ3, drawn by the ray marcher."""
