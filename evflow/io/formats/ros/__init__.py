"""Bags of ROS 1 and ROS 2: messages, the packets in them, and the two kinds of bag."""
