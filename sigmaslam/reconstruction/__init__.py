"""Dense reconstruction: disparities of keyframes, fused into a cloud whose points have covariances, and a mesh."""
