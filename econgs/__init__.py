"""The representation: splatting core, shading, anchors, decoders, context model, bitstream."""
