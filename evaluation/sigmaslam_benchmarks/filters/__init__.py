"""The filter library beside its peers, and on textbook problems."""
