"""The volume itself, compressed: what the methods sz3 and zfp share."""
