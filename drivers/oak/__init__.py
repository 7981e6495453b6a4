"""OAK cameras through DepthAI v3: colour, stereo depth aligned to it, and odometry, over USB and PoE."""
