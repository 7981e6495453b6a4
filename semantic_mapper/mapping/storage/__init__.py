"""Voxel blocks in memory and on disk."""
