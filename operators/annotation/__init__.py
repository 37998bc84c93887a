"""Sessions label themselves (paper section III-C), arrays in, arrays out."""
