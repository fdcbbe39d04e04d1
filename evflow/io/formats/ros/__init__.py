"""ROS 1 and ROS 2 bags: their messages, the event packets in them, and the two kinds of bag."""
