"""Intervals of PSNR."""
