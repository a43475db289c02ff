"""Batched Bayesian filters in torch."""
