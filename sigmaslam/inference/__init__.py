"""Networks and filter steps as ONNX graphs."""
