"""Depth from posed pictures: multi-view stereo for cameras without a depth sensor."""
