"""Fusion of frames and votes into voxel blocks."""
