"""Whatever else OpenCV reads: video files, and streams by their URL (RTSP, HTTP)."""
