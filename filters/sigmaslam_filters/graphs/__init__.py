"""What ships as ONNX: any filter's step (`step_export`), and parts of the tracker's estimator in exportable form."""
