"""Stereo visual SLAM whose covariance can be believed."""
