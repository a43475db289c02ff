"""Networks, their shipped weights and graphs. Nothing here is imported at run time but file paths."""
