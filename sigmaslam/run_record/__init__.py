"""What a run folder holds: each file, written as a run goes on and read back."""
