"""Metrics, peers and benchmarks."""
