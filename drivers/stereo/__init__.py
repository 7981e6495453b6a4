"""Stereo pairs that give both images side by side, such as UVC stereo webcams: rectified, matched, a depth camera."""
