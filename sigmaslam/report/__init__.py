"""The report of a run: one HTML file, its words, plots and 3D view."""
