"""The parts of the filter that ship as ONNX graphs and that the tracker runs; they call no LAPACK."""
