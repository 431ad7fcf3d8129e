"""What bytes and frame times are made of."""
