"""The camera node: publishes posed frames of a camera or of a recorded log."""
