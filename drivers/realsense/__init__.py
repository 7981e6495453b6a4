"""RealSense cameras through Intel's SDK (``pyrealsense2``, extra ``realsense``): colour, and depth aligned to it."""
