"""ONNX: any filter's step as a graph (`step`), and the parts of the filter that the tracker runs as graphs."""
