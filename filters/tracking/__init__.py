"""The tracker's estimator in torch: what the run time calls as ONNX graphs, and what training differentiates.

The functions and modules take one filter. `torch.func.vmap` makes batches of them: hypotheses, or sequences.
"""
