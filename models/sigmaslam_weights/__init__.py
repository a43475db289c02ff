"""Shipped weights (safetensors), graphs (ONNX) and their model cards."""
