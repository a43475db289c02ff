"""Faults that users meet, put into good input: the command line must name each, and lose nothing."""
