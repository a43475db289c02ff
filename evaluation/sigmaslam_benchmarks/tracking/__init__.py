"""Benchmarks: thin scripts that write the tables of docs/."""
