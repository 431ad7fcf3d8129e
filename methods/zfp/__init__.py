"""The volume, compressed by zfp, drawn by the ray marcher."""
