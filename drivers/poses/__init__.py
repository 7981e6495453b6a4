"""Where a camera was when it took an image: the device itself, a fixed place, a topic, a board, or RGB-D odometry."""
