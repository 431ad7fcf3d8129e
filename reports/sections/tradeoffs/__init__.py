"""PSNR against costs."""
