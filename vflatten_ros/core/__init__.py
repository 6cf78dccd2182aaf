"""The method: numpy, scipy and OpenCV only. Knows nothing of ROS, files or clocks."""
