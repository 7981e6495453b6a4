"""Camera poses that fit the pictures: corners followed over keyframes, and their bundle adjustment."""
