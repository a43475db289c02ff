"""Square roots of covariances and products of batched matrices."""
