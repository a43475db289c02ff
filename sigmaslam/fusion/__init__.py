"""Location sensors fused with the tracker's poses."""
